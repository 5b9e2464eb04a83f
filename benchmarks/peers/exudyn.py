"""Exudyn: bodies in absolute coordinates, joints as constraints of index 3 or 2, implicit integrators.

Mechanisms in the x-y plane are made of its planar bodies and joints, whose loops are then not redundant. In space
its default solver refuses redundant loops, and a dense one with full pivoting takes them.
"""

import exudyn
import numpy as np
from exudyn import utilities

from benchmarks.peers.description import Description
from benchmarks.peers.kinematics import Motion, coordinates_of, move
from benchmarks.peers.runs import LONGEST, GaveUp, Run, Setting, steps_between, timed

METHODS = {
    "generalised alpha": exudyn.DynamicSolverType.GeneralizedAlpha,
    "trapezoidal index 2": exudyn.DynamicSolverType.TrapezoidalIndex2,
}
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4)
MANY = 50  # bodies, above which a sparse solver is quicker
TRIAL = 0.02  # part of a run that tells whether all of it would take too long
SENSED = (
    exudyn.OutputVariableType.RotationMatrix,
    exudyn.OutputVariableType.Position,
    exudyn.OutputVariableType.Velocity,
    exudyn.OutputVariableType.AngularVelocity,
)

exudyn.config.printToConsole = False


def settings() -> list[Setting]:
    """From coarse to fine, method by method."""
    return [Setting(method, step) for method in METHODS for step in STEPS]


def run(description: Description, setting: Setting, times) -> Run:
    """One trajectory; a run that fails holds what was reached."""
    every = steps_between(times, setting.step)
    trial = max(1, round(TRIAL * (len(times) - 1)))
    _, _, seconds, _ = _solve(description, setting, times[: trial + 1], every)
    if seconds * (len(times) - 1) / trial > LONGEST:
        raise GaveUp(f"gave up: would take {seconds * (len(times) - 1) / trial:.0f} s")
    reached, motion, seconds, note = _solve(description, setting, times, every)
    found = np.full((2, len(times), len(description.bodies)), np.nan)
    found[:, :reached] = coordinates_of(description, motion)
    return Run(*found, seconds, note)


def _solve(description, setting, times, every):
    """How many of the times were reached, the motion there, seconds, and why it ended early."""
    container = exudyn.SystemContainer()  # which owns the system
    system = container.AddSystem()
    sensors = _build(system, description)
    options = exudyn.SimulationSettings()
    options.timeIntegration.endTime = times[-1]
    options.timeIntegration.numberOfSteps = every * (len(times) - 1)
    options.timeIntegration.adaptiveStep = False
    options.timeIntegration.verboseMode = 0
    options.solutionSettings.writeSolutionToFile = False
    options.solutionSettings.sensorsWritePeriod = times[1]
    if not _is_flat(description):
        options.linearSolver.solverType = exudyn.LinearSolverType.EigenDense
        options.linearSolver.ignoreSingularJacobian = True
    elif len(description.bodies) > MANY:
        options.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse

    def simulate():
        try:
            system.SolveDynamic(options, solverType=METHODS[setting.method], showCausingItems=False)
        except exudyn.SolverError as error:
            return str(error).strip().partition("\n")[0]
        return ""

    note, seconds = timed(simulate)
    stored = [[np.array(system.GetSensorStoredData(sensor)) for sensor in of_body] for of_body in sensors]
    return *_sampled(stored, times), seconds, note


def _is_flat(description):
    """Whether Exudyn's planar bodies will do: they move in the x-y plane."""
    return description.normal is not None and bool(abs(description.normal[2]) > 1.0 - 1e-9)


def _build(system, description):
    """Assembles it, and returns sensors of each body for what is in `SENSED`."""
    at_start = move(description, np.zeros_like(description.speeds)[None], description.speeds[None])
    numbers = [
        system.CreateRigidBody(
            inertia=utilities.RigidBodyInertia(body.mass, body.inertia, com=np.zeros(3)),
            referencePosition=body.center,
            initialVelocity=at_start.velocity[0, index],
            initialAngularVelocity=at_start.spin[0, index],
            gravity=description.gravity,
            create2D=_is_flat(description),
        )
        for index, body in enumerate(description.bodies)
    ]
    numbers.append(system.CreateGround())
    add = _add_flat_joint if _is_flat(description) else _add_joint
    for joint in (*description.tree, *description.cuts):
        add(system, description, joint, [numbers[joint.parent], numbers[joint.child]])
    sensors = [
        [
            system.AddSensor(
                utilities.SensorBody(bodyNumber=number, storeInternal=True, writeToFile=False, outputVariableType=kind)
            )
            for kind in SENSED
        ]
        for number in numbers[:-1]
    ]
    system.Assemble()
    return sensors


def _add_joint(system, _, joint, numbers):
    create = system.CreateRevoluteJoint if joint.kind == "revolute" else system.CreatePrismaticJoint
    create(bodyNumbers=numbers, position=joint.anchor, axis=joint.axis)


def _add_flat_joint(system, description, joint, numbers):
    places = [joint.anchor - description.centers[body] for body in (joint.parent, joint.child)]
    kind = utilities.MarkerBodyPosition if joint.kind == "revolute" else utilities.MarkerBodyRigid
    markers = [
        system.AddMarker(kind(bodyNumber=number, localPosition=place))
        for number, place in zip(numbers, places, strict=True)
    ]
    if joint.kind == "revolute":
        system.AddObject(utilities.ObjectJointRevolute2D(markerNumbers=markers))
    else:
        across = np.cross([0.0, 0.0, 1.0], joint.axis)
        system.AddObject(
            utilities.ObjectJointPrismatic2D(markerNumbers=markers, axisMarker0=joint.axis, normalMarker1=across)
        )


def _sampled(stored, times):
    """How many of the times were reached, and the motion there, from tables with times as first columns."""
    written = stored[0][0][:, 0]
    rows = [np.flatnonzero(np.isclose(written, t, atol=1e-9)) for t in times]
    reached = next((index for index, found in enumerate(rows) if not len(found)), len(times))
    picked = [found[0] for found in rows[:reached]]
    tables = zip(*stored, strict=True)
    axes, *vectors = (np.stack([table[picked, 1:] for table in of_kind], axis=1) for of_kind in tables)
    axes = np.concatenate([axes.reshape(reached, -1, 3, 3), np.tile(np.eye(3), (reached, 1, 1, 1))], axis=1)
    ground = np.zeros((reached, 1, 3))
    return reached, Motion(axes, *(np.concatenate([vector, ground], axis=1) for vector in vectors))
