"""Sensors: what instruments would tell of a motion."""

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from linkax.model.elements import OpenToUsers
from linkax.model.forces.force import Gravity
from linkax.model.joints.distance import Distance
from linkax.model.numbers import (
    is_finite,
    namespace,
    number,
    one_of,
    real,
    require,
    rotation_matrix,
    value,
    whole_number,
)
from linkax.simulation.read.by_name import BodyPoint
from linkax.simulation.read.solution import Solution
from linkax.studies.laboratory.losses import LOSSES, Loss
from linkax.xla.arrays import Array


def _numbers(entry, what) -> Any:
    """One number, or one for each component."""
    array = real(entry, what)
    if array.ndim > 1:
        raise ValueError(f"{what} has shape {array.shape}; give one number, or one for each component")
    return require(array, is_finite, what, "it must be finite")


def _noise(entry) -> Any:
    if entry is None:
        return None
    what = "a sensor's noise"
    positive = lambda array: (namespace(array).asarray(array) > 0.0).all()
    return require(_numbers(entry, what), positive, what, "it must be positive; None where the fit shall find it")


def _components(entry) -> tuple[int, ...] | int | None:
    if entry is None or isinstance(entry, int | np.integer):
        return None if entry is None else whole_number(entry, "a sensor's component", least=0)
    return tuple(whole_number(part, "a sensor's component", least=0) for part in entry)


class AbstractSensor(OpenToUsers):
    """An instrument that tells gain × reading(t − delay) + bias, and noise.

    A sensor type is a subclass with a `reading`. Gain, bias and delay are numbers, known or parameters of a fit.

    **Arguments**, of all sensors, by name:

    - `gain`, `bias`: one number, or one for each component; the bias in the units that the instrument tells.
    - `delay`: how long after the motion it is told [s].
    - `noise`: standard deviation of what is told, one number, or one for each component; None where the fit shall find
      it.
    - `loss`: what residuals cost in a fit: "squares"; or less where there may be outliers: "huber", which beyond 1.3
      times the noise costs in proportion to the residual, or "cauchy", whose cost rises with the logarithm.
    - `components`: index of the one number, or indices of those, that are told of the reading; by default all.

    **Raises:** `ValueError` for numbers that are not finite, noise that is not positive, and an unknown loss.
    """

    _open = frozenset({"gain", "bias", "delay", "noise", "loss", "components", "reading", "reading_between"})

    gain: Float[Array, "..."] = eqx.field(
        default=1.0, kw_only=True, converter=partial(_numbers, what="a sensor's gain")
    )
    bias: Float[Array, "..."] = eqx.field(
        default=0.0, kw_only=True, converter=partial(_numbers, what="a sensor's bias")
    )
    delay: Float[Array, ""] = eqx.field(
        default=0.0, kw_only=True, converter=lambda entry: number(entry, (), "a sensor's delay [s]")
    )
    noise: Float[Array, "..."] | None = eqx.field(default=None, kw_only=True, converter=_noise)
    loss: Loss = eqx.field(
        default="squares", kw_only=True, static=True, converter=lambda entry: one_of(entry, LOSSES, "a sensor's loss")
    )
    components: tuple[int, ...] | int | None = eqx.field(default=None, kw_only=True, static=True, converter=_components)

    @abc.abstractmethod
    def reading(self, solution: Solution) -> Float[Array, "n_t ..."]:
        """What a perfect instrument tells at the times of a solution, (n_t,) or (n_t, k)."""

    def times(self, ts: Float[Array, " n"]) -> Float[Array, " n"]:
        """When the motion was as it is told at times `ts` [s], (n,)."""
        return ts - self.delay

    def reading_between(self, motion: Solution, saved: Solution) -> Float[Array, "n_t ..."]:
        """The same of a motion between the saved times of a solution, see `Solution.at`."""
        return self.reading(motion)

    def told(self, motion: Solution, saved: Solution | None = None) -> Float[Array, "n_t ..."]:
        """What this instrument tells of a motion at `times`, without noise; (n_t,) or (n_t, k).

        **Arguments:** `saved`: the solution that the motion was read from, where it is between saved times.

        **Raises:** `ValueError` for components that the reading does not have, and for gains, biases and noise that are
        neither one number nor one for each component.
        """
        found = jnp.asarray(self.reading(motion) if saved is None else self.reading_between(motion, saved))
        if self.components is not None:
            count = found.shape[1] if found.ndim == 2 else 0
            if np.max(self.components, initial=0) >= count:
                raise ValueError(
                    f"components of {type(self).__name__} are {self.components}; its reading has "
                    f"{count or 'no'} components{f', 0 to {count - 1}' if count else ''}"
                )
            found = found[:, np.array(self.components)]
        each = found.shape[1:]
        for name in ("gain", "bias", "noise"):
            if (shape := np.shape(getattr(self, name))) not in ((), each):
                told = f"{each[0]} numbers; give one number, or {each[0]}" if each else "one number; give one"
                raise ValueError(f"the {name} of {type(self).__name__} has shape {shape}, and it tells {told}")
        return self.gain * found + self.bias

    def predict(self, solution: Solution, ts: Float[Array, " n"] | Sequence[float]) -> Float[Array, "n ..."]:
        """What this instrument tells at times `ts` [s] of a motion, without noise; (n,) or (n, k).

        **Raises:** `ValueError` as `Solution.at` and `told` do.
        """
        return self.told(solution.at(self.times(jnp.asarray(real(ts, "times [s]")))), solution)


class Encoder(AbstractSensor):
    """The coordinate of a joint, in the tree or cut [rad or m]; of several coordinates all.

    The angle of a cut joint is known but for whole turns. It is within half a turn of zero at the first saved time, and
    does not jump from there on, with less than half a turn from one saved time to the next; nor must the measured one.

    **Arguments:** `joint`: its name. Others see `AbstractSensor`.
    """

    joint: str = eqx.field(static=True)

    def reading(self, solution: Solution) -> Float[Array, "n_t ..."]:
        found = solution.joint(self.joint)
        if not np.any(wraps := self._wraps(solution, found)):
            return found
        return jnp.where(wraps, jnp.unwrap(found, axis=0), found)

    def reading_between(self, motion: Solution, saved: Solution) -> Float[Array, "n_t ..."]:
        found = motion.joint(self.joint)
        if not np.any(wraps := self._wraps(motion, found)):
            return found
        before = jnp.maximum(jnp.searchsorted(saved.ts, motion.ts, side="right") - 1, 0)
        turns = jnp.round((self.reading(saved)[before] - found) / (2.0 * jnp.pi))
        return jnp.where(wraps, found + 2.0 * jnp.pi * lax.stop_gradient(turns), found)

    def _wraps(self, solution, found) -> Bool[np.ndarray, "..."]:
        """Whether each coordinate is known but for whole turns."""
        joint = solution.mechanism.joint(self.joint)
        if self.joint in solution.mechanism.topology.coordinates or joint.has_quaternion:
            return np.zeros(found.shape[1:], bool)
        return np.reshape(np.array(joint.speed_units) == "rad", found.shape[1:])


class Tracker(AbstractSensor):
    """The position of a point of a body, in ground axes, (n_t, 3) [m].

    **Arguments:** `body`, `at` as in `Solution.position`. Others see `AbstractSensor`.
    """

    body: str = eqx.field(static=True)
    at: BodyPoint = None

    def reading(self, solution: Solution) -> Float[Array, "n_t 3"]:
        return solution.position(self.body, self.at)


class InertialUnit(AbstractSensor):
    """Specific force and angular velocity of a body, in the unit's axes, (n_t, 6) [m/s², rad/s].

    The specific force is acceleration less that of free fall, of all `Gravity` of the mechanism: what an accelerometer
    at rest tells points upwards. Give gain, bias and noise as six numbers, as the two have different units; or take one
    sensor of `components=(0, 1, 2)`, and one of (3, 4, 5).

    **Arguments:** `body`, `at` as in `Solution.position`. `rotation`: the unit's axes as columns, in the body's axes,
    (3, 3) (default: parallel). Others see `AbstractSensor`.
    """

    body: str = eqx.field(static=True)
    at: BodyPoint = None
    rotation: Any = eqx.field(default=None, converter=lambda entry: rotation_matrix(entry, "InertialUnit: rotation"))

    def reading(self, solution: Solution) -> Float[Array, "n_t 6"]:
        axes = solution.orientation(self.body) @ value(self.rotation)
        gravity = [force.acceleration for force in solution.mechanism.forces if isinstance(force, Gravity)]
        felt = solution.acceleration(self.body, self.at) - sum(gravity, jnp.zeros(3))
        in_axes = lambda vectors: jnp.einsum("tij,ti->tj", axes, vectors)
        return jnp.concatenate([in_axes(felt), in_axes(solution.angular_velocity(self.body))], axis=1)


class ForceCell(AbstractSensor):
    """The reaction of a joint on its child, in the joint's axes, (n_t, 6): force [N], moment [N m]; or the force of an
    element, a constraint or a `Distance`, as `Solution.force` has it.

    **Arguments:** `name`: of a joint, a force element or a constraint. Others see `AbstractSensor`; `components=0` of a
    joint is its force along h¹.
    """

    name: str = eqx.field(static=True)

    def reading(self, solution: Solution) -> Float[Array, "n_t ..."]:
        topology = solution.mechanism.topology
        if self.name not in topology.joints or isinstance(solution.mechanism.joint(self.name), Distance):
            return solution.force(self.name)
        return jnp.concatenate(solution.reaction(self.name, axes="joint"), axis=1)


class StrainGauge(AbstractSensor):
    """The strain along the axis of a beam, at a node and off the axis, (n_t,).

    It is stretch + z κ_y − y κ_z, with the curvatures κ about y and z.

    **Arguments:** `beam`: its name. `node`: counted from 0 at the base. `off`: (y, z) of the gauge from the axis [m].
    Others see `AbstractSensor`.
    """

    beam: str = eqx.field(static=True)
    node: int = eqx.field(static=True, converter=lambda entry: whole_number(entry, "StrainGauge: node", least=0))
    off: Float[Array, "2"] = eqx.field(
        default=(0.0, 0.0), converter=lambda entry: number(entry, (2,), "StrainGauge: off [m]")
    )

    def reading(self, solution: Solution) -> Float[Array, " n_t"]:
        strains = solution.strain(self.beam)
        if self.node >= strains.shape[1]:
            raise ValueError(
                f"StrainGauge: node is {self.node}; beam {self.beam!r} has nodes 0 to {strains.shape[1] - 1}"
            )
        _, about_y, about_z, stretch, _, _ = jnp.moveaxis(strains[:, self.node], -1, 0)
        y, z = self.off
        return stretch + z * about_y - y * about_z


class Reading(AbstractSensor):
    """Any function of a `Solution`.

    **Arguments:** `function`: solution -> (n_t,) or (n_t, k). Others see `AbstractSensor`.
    """

    function: Callable[[Solution], Any]

    def reading(self, solution: Solution) -> Float[Array, "n_t ..."]:
        return self.function(solution)
