"""Clavel's Delta robot, which picks and places, with sizes like those of ABB's IRB 340 FlexPicker.

Three arms at motors carry a platform on two parallel rods each, so that it only translates. Rods have a Cardan joint
at the arm and a ball at the platform: two balls in the machine, where springs keep a rod from spinning. So no row is
redundant. Clavel, Delta, a Fast Robot With Parallel Geometry, 18th Int. Symposium on Industrial Robots (1988). Sizes
(base 0.2 m, platform 0.045 m, arms 0.235 m, rods 0.8 m) are quoted from memory, masses are our own.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import linkax as lx
from linkax.model.numbers import Number
from linkax.scenes.planar import closed
from linkax.scenes.scene import Parameters, described
from linkax.xla.arrays import Array, Scalar

NUMBERS = ("base", "platform", "arm", "rod", "width", "lift", "depth", "period")
ARMS = (1, 2, 3)
SIDES = {"a": -1.0, "b": 1.0}  # of the rods of an arm


class Path(eqx.Module):
    """Where the platform is, and the angles of the arms at that, in closed form."""

    numbers: dict[str, Scalar]

    def __call__(self, t: Number) -> Float[Array, "3"]:
        """Compute the place of the platform [m], from a place at −x over the middle to one at +x, and back."""
        numbers = self.numbers
        along = jnp.cos(2.0 * jnp.pi * t / numbers["period"])
        up = numbers["lift"] * (1.0 - along**4) - numbers["depth"]
        return jnp.stack([-numbers["width"] / 2.0 * along, jnp.zeros_like(up), up])

    def arm(self, arm: int, place: Float[Array, "3"]) -> Scalar:
        """Compute how far an arm is turned down from the horizontal [rad], its elbow outward."""
        n = self.numbers
        out, across, up = _axes(arm).T @ place
        out = out + n["platform"] - n["base"]
        # Elbow and platform are a rod apart: out cos θ − up sin θ = reach.
        reach = (out**2 + across**2 + up**2 + n["arm"] ** 2 - n["rod"] ** 2) / (2.0 * n["arm"])
        return jnp.arctan2(-up, out) - jnp.arccos(reach / jnp.hypot(out, up))


class Turn(eqx.Module):
    """The angle that a motor turns its arm down from the horizontal [rad]."""

    path: Path
    number: int = eqx.field(static=True)

    def __call__(self, t: Number) -> Scalar:
        return self.path.arm(self.number, self.path(t))


def _axes(arm: int) -> np.ndarray:
    """Axes of an arm as columns: outward, along its motor's axis, up."""
    cos, sin = np.cos(2.0 * np.pi * (arm - 1) / 3.0), np.sin(2.0 * np.pi * (arm - 1) / 3.0)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _path(parameters: Parameters) -> Path:
    return Path({name: jnp.asarray(parameters[name]) for name in NUMBERS})


@jax.jit
def _start(path: Path) -> dict[str, Array]:
    """Coordinates of motors and elbows, and the place of the platform, at t = 0."""
    numbers, platform, found = path.numbers, path(0.0), {}
    for arm in ARMS:
        angle = found[f"motor_{arm}"] = path.arm(arm, platform)
        forward = jnp.stack([jnp.cos(angle), jnp.zeros_like(angle), -jnp.sin(angle)])
        out = numbers["platform"] - numbers["base"]
        rod = _axes(arm).T @ platform + out * jnp.array([1.0, 0.0, 0.0]) - numbers["arm"] * forward
        turned = jnp.stack([jnp.arctan2(-rod[2], rod[0]) - angle, jnp.arcsin(rod[1] / numbers["rod"])])
        found |= {f"elbow_{arm}{letter}": turned for letter in SIDES}
    return found | {"platform": platform}


def _mechanism(parameters: Parameters) -> lx.Mechanism:
    path, spread = _path(parameters), parameters["spread"]
    closed(_start(path), "delta")
    platform = lx.point_mass("platform", parameters["platform_mass"] + parameters["payload"])
    bodies, joints, drives = [platform], [], []
    for number in ARMS:
        axes = _axes(number)
        (cos, sin, _), across = axes[:, 0], axes[:, 1]
        arm = lx.rod(f"arm_{number}", parameters["arm"], parameters["arm_mass"])
        base = lx.GROUND.at([parameters["base"] * cos, parameters["base"] * sin, 0.0], axes)
        joints.append(lx.Revolute(f"motor_{number}", base, arm.at("base"), axis="y"))
        drives.append(lx.Drive(f"drive_{number}", f"motor_{number}", Turn(path, number)))
        bodies.append(arm)
        for letter, side in SIDES.items():
            aside = side * spread / 2.0
            rod = lx.rod(f"rod_{number}{letter}", parameters["rod"], parameters["rod_mass"])
            end = [
                parameters["platform"] * cos + aside * across[0],
                parameters["platform"] * sin + aside * across[1],
                0.0,
            ]
            joints += [
                lx.Universal(f"elbow_{number}{letter}", arm.at([parameters["arm"], aside, 0.0]), rod, axis="y"),
                lx.Spherical(f"ball_{number}{letter}", rod.at("tip"), platform.at(end)),
            ]
            bodies.append(rod)
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, 0.0, -parameters["gravity"]])], drives)


def _initial(mechanism: lx.Mechanism, parameters: Parameters) -> lx.State:
    start = _start(_path(parameters))
    return lx.assemble(mechanism, guess=start | {"platform": lx.Pose(start["platform"], np.eye(3))})


def _exact(parameters: Parameters, times: Array) -> dict[str, np.ndarray]:
    return {"platform": np.asarray(jax.vmap(_path(parameters))(jnp.asarray(times)))}


DELTA = described(
    "delta",
    mechanism=_mechanism,
    initial=_initial,
    points=lambda parameters: {"platform": ("platform", None)},
    exact=_exact,
)
