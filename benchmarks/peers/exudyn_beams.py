"""Exudyn on the problems of `benchmarks.beams`: cable elements of absolute nodal coordinates, generalised alpha."""

from itertools import pairwise

import exudyn
import numpy as np
from exudyn import utilities

from benchmarks.peers.runs import timed

exudyn.config.printToConsole = False
POSITION = exudyn.OutputVariableType.Position
IN_PLANE = [1, 1, 0, 0, 0, 1]  # translations along x and y, rotation about z


def run(problem, elements: int, steps: int):
    """Positions of the beam's base, middle and tip at the saved times, (3, n_t, 2), and seconds."""
    container = exudyn.SystemContainer()  # which owns the system
    system = container.AddSystem()
    sensors = _build(system, problem, elements)
    options = exudyn.SimulationSettings()
    options.timeIntegration.endTime = problem.duration
    options.timeIntegration.numberOfSteps = steps
    options.timeIntegration.verboseMode = 0
    options.timeIntegration.newton.useModifiedNewton = True
    options.solution.file.write = False
    options.solution.sensors.writePeriod = problem.duration / problem.saves
    _, seconds = timed(lambda: system.SolveDynamic(options))
    return np.stack([np.array(system.GetSensorStoredData(sensor))[:, 1:3] for sensor in sensors]), seconds


def _build(system, problem, elements):
    place = lambda body, x: system.AddMarker(utilities.MarkerBodyRigid(bodyNumber=body, localPosition=[x, 0, 0]))
    hold = lambda axes, *markers: system.AddObject(
        utilities.GenericJoint(markerNumbers=list(markers), constrainedAxes=axes)
    )
    pinned = [1, 1, 0, 0, 0, 0]
    ground = system.AddObject(utilities.ObjectGround())
    hub_node = system.AddNode(
        utilities.NodeRigidBody2D(referenceCoordinates=[0, 0, 0], initialVelocities=[0, 0, problem.speed])
    )
    hub = system.AddObject(utilities.ObjectRigidBody2D(mass=1.0, inertia=problem.hub_inertia, nodeNumber=hub_node))
    hold(pinned, place(ground, 0.0), place(hub, 0.0))
    turned = system.AddMarker(utilities.MarkerNodeCoordinate(nodeNumber=hub_node, coordinate=2))
    system.AddLoad(utilities.LoadCoordinate(markerNumber=turned, load=problem.torque))

    base, turning = problem.arm, problem.beam_turning
    nodes = [
        system.AddNode(
            utilities.NodePoint2DSlope1(
                referenceCoordinates=[base + x, 0, 1, 0],
                initialVelocities=[0, problem.speed * base + turning * x, 0, turning],
            )
        )
        for x in np.linspace(0.0, problem.length, elements + 1)
    ]
    cables = [
        system.AddObject(
            utilities.ObjectANCFCable2D(
                length=problem.length / elements,
                massPerLength=problem.linear_density,
                bendingStiffness=problem.bending_stiffness,
                axialStiffness=problem.axial_stiffness,
                nodeNumbers=list(ends),
            )
        )
        for ends in pairwise(nodes)
    ]
    hold(pinned if problem.slider else IN_PLANE, place(hub, base), place(cables[0], 0.0))
    if problem.slider:
        node = system.AddNode(utilities.NodePoint2D(referenceCoordinates=[base + problem.length, 0]))
        slider = system.AddObject(utilities.ObjectMassPoint2D(mass=problem.slider, nodeNumber=node))
        ends = system.AddMarker(utilities.MarkerNodePosition(nodeNumber=nodes[-1]))
        point = system.AddMarker(utilities.MarkerBodyPosition(bodyNumber=slider, localPosition=[0, 0, 0]))
        system.AddObject(utilities.ObjectJointRevolute2D(markerNumbers=[ends, point]))
        across = system.AddMarker(utilities.MarkerNodeCoordinate(nodeNumber=node, coordinate=1))
        still = system.AddNode(utilities.NodePointGround())
        fixed = system.AddMarker(utilities.MarkerNodeCoordinate(nodeNumber=still, coordinate=0))
        system.AddObject(utilities.ObjectConnectorCoordinate(markerNumbers=[fixed, across]))
    sensor = lambda node: utilities.SensorNode(nodeNumber=node, storeInternal=True, outputVariableType=POSITION)
    sensors = [system.AddSensor(sensor(node)) for node in (nodes[0], nodes[elements // 2], nodes[-1])]
    system.Assemble()
    return sensors
