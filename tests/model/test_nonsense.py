"""Nonsense in place of any one argument is taken, or refused by a clear error: no traceback from inside JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from refusals import clear

import linkax as lx

LINK, OTHER = lx.rod("link", 1.0, 1.0), lx.rod("other", 1.0, 1.0)
PIN = lx.Revolute("pin", lx.GROUND, LINK, "z")
STEEL = lx.Material(2.1e11, 0.3, 7850.0)
BOOM = lx.Beam("boom", 1.0, lx.rectangle(0.1, 0.2, STEEL), elements=2)
ENDS = {"parent": lx.GROUND, "child": LINK}
MECHANISM = lx.Mechanism([LINK], [PIN])
PAIR = {"first": LINK, "second": lx.GROUND}
CALLS = {
    "RigidBody": (lx.RigidBody, {
        "name": "body", "mass": 1.0, "center_of_mass": [0, 0, 0], "inertia": [1, 1, 1], "frames": {},
    }),
    "rod": (lx.rod, {"name": "rod", "length": 1.0, "mass": 1.0}),
    "point_mass": (lx.point_mass, {"name": "point", "mass": 1.0}),
    "box": (lx.box, {"name": "box", "size": [1, 1, 1], "mass": 1.0}),
    "at of a body": (LINK.at, {"where": "tip", "rotation": None}),
    "at of the ground": (lx.GROUND.at, {"offset": [0, 0, 0], "rotation": None}),
    "at of a beam": (BOOM.at, {"where": 0.4, "rotation": None, "element": 0}),
    "Beam": (lx.Beam, {
        "name": "beam", "length": 1.0, "section": BOOM.section, "elements": 2, "bends": "y", "torsion": True,
        "stretch": True, "shear": True, "damping": 0.0,
    }),
    "Material": (lx.Material, {"youngs_modulus": 1.0, "poissons_ratio": 0.3, "density": 1.0}),
    "Section": (lx.Section, {
        "bending_stiffness": 1.0, "linear_density": 1.0, "axial_stiffness": 1.0, "torsional_stiffness": 1.0,
        "shear_stiffness": 1.0, "rotary_inertia": 1.0,
    }),
    "rectangle": (lx.rectangle, {"width": 1.0, "height": 1.0, "material": STEEL, "thickness": 0.1}),
    "circle": (lx.circle, {"diameter": 1.0, "material": STEEL, "thickness": 0.1}),
    **{
        kind.__name__: (kind, {"name": "joint", **ENDS, "axis": "z", "cut": False})
        for kind in (lx.Revolute, lx.Prismatic, lx.Cylindrical, lx.Planar)
    },
    **{kind.__name__: (kind, {"name": "joint", **ENDS, "cut": False}) for kind in (lx.Spherical, lx.Fixed, lx.Free)},
    "Universal": (lx.Universal, {"name": "joint", **ENDS, "axis": "z", "second_axis": "x", "cut": False}),
    "Screw": (lx.Screw, {"name": "nut", **ENDS, "axis": "z", "pitch": 1.0, "cut": False}),
    "Distance": (lx.Distance, {"name": "tie", **ENDS, "length": 1.0}),
    "Sliding": (lx.Sliding, {"name": "sleeve", "beam": BOOM, "child": LINK}),
    "Rope": (lx.Rope, {"name": "hoist", "points": [lx.GROUND, LINK], "length": 1.0}),
    "Coupling": (lx.Coupling, {"name": "gears", "coefficients": {"pin": 1.0}, "offset": 0.0}),
    "PolynomialCoupling": (lx.PolynomialCoupling, {
        "name": "curve", "joint": "pin", "of": {"knee": 1.0}, "coefficients": [0.0, 1.0, 2.0],
    }),
    "Drive": (lx.Drive, {"name": "motor", "joint": "pin", "motion": jnp.sin}),
    "Gravity": (lx.Gravity, {"acceleration": [0, 0, 1]}),
    "Spring": (lx.Spring, {**PAIR, "stiffness": 1.0, "free_length": 1.0}),
    "Damper": (lx.Damper, {**PAIR, "damping": 1.0}),
    "ElasticRope": (lx.ElasticRope, {
        "points": [lx.GROUND, LINK], "stiffness": 1.0, "free_length": 1.0, "damping": 0.0,
    }),
    "PointForce": (lx.PointForce, {"point": LINK, "force": [0, 0, 1], "axes": "ground"}),
    "PointMoment": (lx.PointMoment, {"point": LINK, "moment": [0, 0, 1], "axes": "ground"}),
    "JointTorque": (lx.JointTorque, {"joint": "pin", "torque": 1.0}),
    "JointSpring": (lx.JointSpring, {"joint": "pin", "stiffness": 1.0, "free": 0.0}),
    "JointDamper": (lx.JointDamper, {"joint": "pin", "damping": 1.0}),
    "JointFriction": (lx.JointFriction, {"joint": "pin", "torque": 1.0, "scale": 1.0}),
    "JointInertia": (lx.JointInertia, {"joint": "pin", "inertia": 1.0}),
    "AffineActuator": (lx.AffineActuator, {
        "transmission": {"pin": 1.0}, "control": 1.0, "gain": 1.0, "bias": [0, -1, 0], "force_range": [-1, 1],
    }),
    "Mechanism": (lx.Mechanism, {
        "bodies": [LINK], "joints": [PIN], "forces": [], "constraints": [], "all_rows": False,
    }),
    "body of a mechanism": (MECHANISM.body, {"name": "link"}),
    "joint of a mechanism": (MECHANISM.joint, {"name": "pin"}),
    "Accuracy": (lx.Accuracy, {
        "rtol": 1e-8, "atol": 1e-8, "projection": "both", "clearance": 0.0,
    }),
    "TangentSpace": (lx.TangentSpace, {"rank_tolerance": 1e-6, "metric": "mass", "corrections": 1}),
    "Baumgarte": (lx.Baumgarte, {"alpha": 1.0, "beta": 1.0}),
    "Positive": (lx.Positive, {"value": 1.0}),
    "Bounded": (lx.Bounded, {"value": 0.5, "lower": 0.0, "upper": 1.0}),
    "PhysicalInertia": (lx.PhysicalInertia, {"mass": 1.0, "center_of_mass": [0, 0, 0], "inertia": [1, 1, 1]}),
}  # fmt: skip
TRACED = [
    1.0, -1.0, 2, True, 1.0j, jnp.ones(2), jnp.ones(3), jnp.zeros(3), jnp.eye(3), jnp.ones((3, 3)), jnp.zeros(0),
    jnp.arange(3), jnp.bfloat16(1.0), jnp.ones((2, 2, 2)),
]  # fmt: skip
NONSENSE = [
    np.nan, np.inf, -1.0, 0.0, 1j, None, "x", "", b"1", True, [], [1.0], [[1.0]], {}, 10**400, 2**63, 1e308, 5e-324,
    object(), np.array([1, 2]), np.zeros((3, 3)), np.zeros(0), np.array("s"), np.array(None), np.datetime64("2020"),
    np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False]), jnp.full(3, jnp.nan), lambda: 1, (1, 2, 3),
    [1, "a", None], ("x", 0), range(3), type, np.longdouble(1.0), {"a": 1}, set(), slice(1), ..., NotImplemented,
    lx.GROUND, LINK, BOOM, PIN, lx.Revolute, [LINK], [jnp.ones(()), "x"], *map(jnp.asarray, TRACED),
]  # fmt: skip


def _checked(call, arguments, name, value):
    try:
        with unchecked():
            return jax.tree.leaves(call(**arguments | {name: value}))
    except Exception as error:
        return clear(error, ()) and []


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of numbers whose squares overflow
@pytest.mark.parametrize("case", CALLS)
def test_nonsense_is_taken_or_named(case):
    call, arguments = CALLS[case]
    call(**arguments)

    def traced(values):
        for name in arguments:
            for value in values:
                _checked(call, arguments, name, value)
                _checked(call, arguments, name, [value, 1.0, 0.0])

    for name in arguments:
        for value in NONSENSE:
            _checked(call, arguments, name, value)
    jax.eval_shape(traced, TRACED)
