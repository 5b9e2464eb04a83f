"""Pinocchio: `constraintDynamics`, a proximal solve that takes redundant loops, under integrators in Python."""

from typing import NamedTuple

import numpy as np
import pinocchio
from scipy.integrate import DOP853

from benchmarks.peers.description import GROUND, Description
from benchmarks.peers.runs import Deadline, Run, Setting, steps_between, timed

MODELS = {
    "revolute": pinocchio.JointModelRevoluteUnaligned,
    "prismatic": pinocchio.JointModelPrismaticUnaligned,
}
EVALUATIONS = 200  # of the right-hand side, timed together


class Method(NamedTuple):
    """How to integrate.

    - `adaptive`: by SciPy's DOP853 to a tolerance, or by RK4 in steps.
    - `frequency`: of Baumgarte's stabilisation, critically damped [1/s], or times the step where there are steps.
    - `proximal`: μ, which is added to what loops oppose to forces, and iterated away.
    """

    adaptive: bool
    frequency: float
    proximal: float


METHODS = {
    "RK4": Method(False, 0.0, 1e-12),
    "RK4 μ=1e-8": Method(False, 0.0, 1e-8),
    "RK4 Baumgarte": Method(False, 0.2, 1e-12),
    "RK4 Baumgarte μ=1e-8": Method(False, 0.2, 1e-8),
    "DOP853 Baumgarte": Method(True, 20.0, 1e-12),
}
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4)
TOLERANCES = (1e-4, 1e-6, 1e-9, 1e-12)


def settings() -> list[Setting]:
    """From coarse to fine, method by method."""
    steps = lambda method: TOLERANCES if method.adaptive else STEPS
    return [Setting(name, step) for name, method in METHODS.items() for step in steps(method)]


def run(description: Description, setting: Setting, times) -> Run:
    """One trajectory; most of the time goes into calls from Python."""
    method = METHODS[setting.method]
    frequency = method.frequency if method.adaptive else method.frequency / setting.step
    equations = _Equations(description, frequency, method.proximal)
    integrate = _dop853 if method.adaptive else _rk4
    states, seconds = timed(lambda: integrate(equations, setting.step, times))
    coordinates, speeds = np.split(states, 2, axis=1)
    return Run(coordinates[:, equations.order], speeds[:, equations.order], seconds)


def microseconds_per_evaluation(description: Description) -> float:
    """Of one right-hand side: `constraintDynamics` at the start, called from Python in a loop."""
    equations = _Equations(description, 0.0, 1e-12)
    arguments = equations.arguments(equations.start)

    def evaluate():
        for _ in range(EVALUATIONS):
            pinocchio.constraintDynamics(*arguments)

    evaluate()
    return min(timed(evaluate)[1] for _ in range(5)) / EVALUATIONS * 1e6


class _Equations:
    """Rates of coordinates and speeds, y of (2 n,), in Pinocchio's order; `order` gives the description's."""

    def __init__(self, description, frequency, proximal):
        self.model, joints = _tree(description)
        self.order = np.array([self.model.idx_vs[joints[index]] for index in range(len(description.tree))])
        self.loops, self.loop_data = pinocchio.StdVec_RigidConstraintModel(), pinocchio.StdVec_RigidConstraintData()
        for joint, point in description.loop_points:
            loop = _loop(self.model, description, joints, joint, point)
            stabilisation = pinocchio.BaumgarteCorrectorParameters(frequency**2, 2.0 * frequency)
            loop.setBaumgarteCorrectorParameters(stabilisation)
            self.loops.append(loop)
            self.loop_data.append(loop.createData())
        self.data = self.model.createData()
        self.proximal = pinocchio.ProximalSettings(1e-12, proximal, 20)
        self.torque = np.zeros(self.model.nv)
        pinocchio.initConstraintDynamics(self.model, self.data, self.loops, self.loop_data)
        speeds = np.zeros(self.model.nv)
        speeds[self.order] = description.speeds
        self.start = np.concatenate([np.zeros(self.model.nv), speeds])

    def arguments(self, y):
        """Of `constraintDynamics`."""
        coordinates, speeds = y[: self.model.nv], y[self.model.nv :]
        return self.model, self.data, coordinates, speeds, self.torque, self.loops, self.loop_data, self.proximal

    def __call__(self, y):
        acceleration = pinocchio.constraintDynamics(*self.arguments(y))
        return np.concatenate([y[self.model.nv :], acceleration])


def _tree(description):
    """The model without loops, and the number of each joint in it, ground's too."""
    model = pinocchio.Model()
    model.gravity = pinocchio.Motion(np.concatenate([description.gravity, np.zeros(3)]))
    joints = {GROUND: 0}
    for index in _depth_first(description):
        body, joint = description.bodies[index], description.tree[index]
        placement = _at(joint.anchor - _origin(description, joint.parent))
        kind = MODELS[joint.kind](joint.axis)
        joints[index] = model.addJoint(joints[joint.parent], kind, placement, joint.name)
        inertia = pinocchio.Inertia(body.mass, body.center - joint.anchor, body.inertia)
        model.appendBodyToJoint(joints[index], inertia, pinocchio.SE3.Identity())
    return model, joints


def _depth_first(description, body=GROUND):
    """Bodies that a body carries, the order in which Pinocchio's sums over subtrees are right; it does not check."""
    for index, joint in enumerate(description.tree):
        if joint.parent == body:
            yield index
            yield from _depth_first(description, index)


def _loop(model, description, joints, joint, point):
    """A point of both bodies of a cut joint."""
    ends = []
    for body in (joint.parent, joint.child):
        ends += [joints[body], _at(point - _origin(description, body))]
    kind, axes = pinocchio.ContactType.CONTACT_3D, pinocchio.ReferenceFrame.LOCAL
    return pinocchio.RigidConstraintModel(kind, model, *ends, axes)


def _origin(description, body):
    """Of a body's frame, which is that of its joint [m]."""
    return np.zeros(3) if body == GROUND else description.tree[body].anchor


def _at(place):
    return pinocchio.SE3(np.eye(3), place)


def _rk4(equations, step, times):
    y, deadline = equations.start, Deadline()
    states = np.full((len(times), len(y)), np.nan)
    states[0] = y
    for index in range(1, len(times)):
        for _ in range(steps_between(times, step)):
            k1 = equations(y)
            k2 = equations(y + step / 2.0 * k1)
            k3 = equations(y + step / 2.0 * k2)
            k4 = equations(y + step * k3)
            y = y + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        if not np.all(np.isfinite(y)):
            break
        states[index] = y
        deadline.check(times[index])
    return states


def _dop853(equations, tolerance, times):
    solver = DOP853(lambda _, y: equations(y), 0.0, equations.start, times[-1], rtol=tolerance, atol=tolerance)
    deadline = Deadline()
    states = np.full((len(times), len(equations.start)), np.nan)
    states[0] = equations.start
    while solver.status == "running":
        solver.step()
        deadline.check(solver.t)
        passed = (times > solver.t_old) & (times <= solver.t)
        if np.any(passed):
            states[passed] = solver.dense_output()(times[passed]).T
    return states
