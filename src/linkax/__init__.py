"""Differentiable simulation of mechanisms with exact closed loops.

Importing linkax switches JAX to double precision (`jax_enable_x64`): loops cannot be closed to
rounding, nor singular configurations passed, in single precision. `simulate(dtype=jnp.float32)`
computes in single precision all the same. And SciPy's LAPACK, which compiled programs call, gets one thread, unless
`OPENBLAS_NUM_THREADS` or the like say otherwise, see `linkax.xla.lapack_threads`.
"""

from importlib import import_module as _import_module
from types import ModuleType as _Module
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

import jax

from linkax.xla.lapack_threads import watch_lapack
from linkax.xla.memory_maps import watch_memory_maps

jax.config.update("jax_enable_x64", True)
watch_lapack()
watch_memory_maps()

from linkax.analysis.equilibrium import EquilibriumError as EquilibriumError  # noqa: E402
from linkax.analysis.equilibrium import StabilityWarning as StabilityWarning  # noqa: E402
from linkax.analysis.equilibrium import equilibrium as equilibrium  # noqa: E402
from linkax.analysis.inverse_dynamics import InverseDynamics as InverseDynamics  # noqa: E402
from linkax.analysis.inverse_dynamics import inverse_dynamics as inverse_dynamics  # noqa: E402
from linkax.analysis.linearisation import Linearisation as Linearisation  # noqa: E402
from linkax.analysis.mobility import Mobility as Mobility  # noqa: E402
from linkax.analysis.mobility import mobility as mobility  # noqa: E402
from linkax.analysis.trace import Trace as Trace  # noqa: E402
from linkax.analysis.trace import TraceError as TraceError  # noqa: E402
from linkax.analysis.trace import trace as trace  # noqa: E402
from linkax.analysis.vibration import linearise as linearise  # noqa: E402
from linkax.analysis.workspace import Workspace as Workspace  # noqa: E402
from linkax.analysis.workspace import workspace as workspace  # noqa: E402
from linkax.equations.motion import Motion as Motion  # noqa: E402
from linkax.equations.reactions import Reaction as Reaction  # noqa: E402
from linkax.formulations.augmented_lagrangian import AugmentedLagrangian as AugmentedLagrangian  # noqa: E402
from linkax.formulations.classical import Baumgarte as Baumgarte  # noqa: E402
from linkax.formulations.classical import ClassicalFormulation as ClassicalFormulation  # noqa: E402
from linkax.formulations.coordinate_partitioning import CoordinatePartitioning as CoordinatePartitioning  # noqa: E402
from linkax.formulations.lagrange_multipliers import LagrangeMultipliers as LagrangeMultipliers  # noqa: E402
from linkax.formulations.moore_penrose import MassOrthogonalProjection as MassOrthogonalProjection  # noqa: E402
from linkax.formulations.moore_penrose import MoorePenrose as MoorePenrose  # noqa: E402
from linkax.formulations.projection_operator import ProjectionOperator as ProjectionOperator  # noqa: E402
from linkax.formulations.tangent_space import TangentSpace as TangentSpace  # noqa: E402
from linkax.linalg.pivoted_qr import pivoted_qr as pivoted_qr  # noqa: E402
from linkax.machines.draft import LeftOutWarning as LeftOutWarning  # noqa: E402
from linkax.machines.load import load as load  # noqa: E402
from linkax.machines.machine import LeftOut as LeftOut  # noqa: E402
from linkax.machines.machine import Machine as Machine  # noqa: E402
from linkax.machines.machine import Start as Start  # noqa: E402
from linkax.machines.write_mjcf.coordinates import mujoco_trajectory as mujoco_trajectory  # noqa: E402
from linkax.machines.write_mjcf.write import to_mjcf as to_mjcf  # noqa: E402
from linkax.machines.xml import MachineFileError as MachineFileError  # noqa: E402
from linkax.model.attached import Attached as Attached  # noqa: E402
from linkax.model.attached import Moving as Moving  # noqa: E402
from linkax.model.beams import Beam as Beam  # noqa: E402
from linkax.model.bodies import GROUND as GROUND  # noqa: E402
from linkax.model.bodies import Frame as Frame  # noqa: E402
from linkax.model.bodies import RigidBody as RigidBody  # noqa: E402
from linkax.model.bodies import box as box  # noqa: E402
from linkax.model.bodies import point_mass as point_mass  # noqa: E402
from linkax.model.calls import explain_slips  # noqa: E402
from linkax.model.constraints.constraint import AbstractConstraint as AbstractConstraint  # noqa: E402
from linkax.model.constraints.constraint import Coupling as Coupling  # noqa: E402
from linkax.model.constraints.constraint import Drive as Drive  # noqa: E402
from linkax.model.constraints.gears import Gear as Gear  # noqa: E402
from linkax.model.constraints.gears import Rack as Rack  # noqa: E402
from linkax.model.constraints.guides import PointOnSurface as PointOnSurface  # noqa: E402
from linkax.model.constraints.guides import Prescribed as Prescribed  # noqa: E402
from linkax.model.constraints.polynomial_coupling import PolynomialCoupling as PolynomialCoupling  # noqa: E402
from linkax.model.constraints.rolling import RollingDisc as RollingDisc  # noqa: E402
from linkax.model.constraints.rolling import RollingSphere as RollingSphere  # noqa: E402
from linkax.model.constraints.rolling import Skate as Skate  # noqa: E402
from linkax.model.constraints.ropes import ElasticRope as ElasticRope  # noqa: E402
from linkax.model.constraints.ropes import Rope as Rope  # noqa: E402
from linkax.model.constraints.wheel_on_rail import WheelOnRail as WheelOnRail  # noqa: E402
from linkax.model.curves import PeriodicSpline as PeriodicSpline  # noqa: E402
from linkax.model.curves import SplineCurve as SplineCurve  # noqa: E402
from linkax.model.forces.actuators import DCMotor as DCMotor  # noqa: E402
from linkax.model.forces.actuators import PneumaticSpring as PneumaticSpring  # noqa: E402
from linkax.model.forces.affine_actuator import AffineActuator as AffineActuator  # noqa: E402
from linkax.model.forces.contact import Clearance as Clearance  # noqa: E402
from linkax.model.forces.contact import Contact as Contact  # noqa: E402
from linkax.model.forces.contact_law import ContactLaw as ContactLaw  # noqa: E402
from linkax.model.forces.contact_law import Friction as Friction  # noqa: E402
from linkax.model.forces.controllers import FirstOrderSensor as FirstOrderSensor  # noqa: E402
from linkax.model.forces.controllers import PIDController as PIDController  # noqa: E402
from linkax.model.forces.creep import Creep as Creep  # noqa: E402
from linkax.model.forces.creep import WheelRailContact as WheelRailContact  # noqa: E402
from linkax.model.forces.force import AbstractForce as AbstractForce  # noqa: E402
from linkax.model.forces.force import Gravity as Gravity  # noqa: E402
from linkax.model.forces.force import Load as Load  # noqa: E402
from linkax.model.forces.hydraulics import HydraulicActuator as HydraulicActuator  # noqa: E402
from linkax.model.forces.hydraulics import HydraulicCylinder as HydraulicCylinder  # noqa: E402
from linkax.model.forces.impacts import Impact as Impact  # noqa: E402
from linkax.model.forces.internal_states import InternalState as InternalState  # noqa: E402
from linkax.model.forces.joint_forces import JointDamper as JointDamper  # noqa: E402
from linkax.model.forces.joint_forces import JointFriction as JointFriction  # noqa: E402
from linkax.model.forces.joint_forces import JointInertia as JointInertia  # noqa: E402
from linkax.model.forces.joint_forces import JointSpring as JointSpring  # noqa: E402
from linkax.model.forces.joint_forces import JointTorque as JointTorque  # noqa: E402
from linkax.model.forces.joint_limits import JointLimit as JointLimit  # noqa: E402
from linkax.model.forces.point_forces import Damper as Damper  # noqa: E402
from linkax.model.forces.point_forces import PointForce as PointForce  # noqa: E402
from linkax.model.forces.point_forces import PointMoment as PointMoment  # noqa: E402
from linkax.model.forces.point_forces import Spring as Spring  # noqa: E402
from linkax.model.forces.rate_dependent import LuGreFriction as LuGreFriction  # noqa: E402
from linkax.model.forces.rate_dependent import MaxwellElement as MaxwellElement  # noqa: E402
from linkax.model.forces.shapes import Capsule as Capsule  # noqa: E402
from linkax.model.forces.shapes import Plane as Plane  # noqa: E402
from linkax.model.forces.shapes import Sphere as Sphere  # noqa: E402
from linkax.model.joints.bending import Sliding as Sliding  # noqa: E402
from linkax.model.joints.cam import Cam as Cam  # noqa: E402
from linkax.model.joints.constant_velocity import ConstantVelocity as ConstantVelocity  # noqa: E402
from linkax.model.joints.curve import CurveJoint as CurveJoint  # noqa: E402
from linkax.model.joints.cylindrical import Cylindrical as Cylindrical  # noqa: E402
from linkax.model.joints.distance import Distance as Distance  # noqa: E402
from linkax.model.joints.fixed import Fixed as Fixed  # noqa: E402
from linkax.model.joints.free import Free as Free  # noqa: E402
from linkax.model.joints.joint import AbstractJoint as AbstractJoint  # noqa: E402
from linkax.model.joints.planar import Planar as Planar  # noqa: E402
from linkax.model.joints.prismatic import Prismatic as Prismatic  # noqa: E402
from linkax.model.joints.rectangular import Rectangular as Rectangular  # noqa: E402
from linkax.model.joints.revolute import Revolute as Revolute  # noqa: E402
from linkax.model.joints.screw import Screw as Screw  # noqa: E402
from linkax.model.joints.spherical import Spherical as Spherical  # noqa: E402
from linkax.model.joints.universal import Universal as Universal  # noqa: E402
from linkax.model.linkages import linkage as linkage  # noqa: E402
from linkax.model.mechanism import Mechanism as Mechanism  # noqa: E402
from linkax.model.poses import Pose as Pose  # noqa: E402
from linkax.model.poses import Velocity as Velocity  # noqa: E402
from linkax.model.rods import rod as rod  # noqa: E402
from linkax.model.rods import rod_between as rod_between  # noqa: E402
from linkax.model.sections import Material as Material  # noqa: E402
from linkax.model.sections import Section as Section  # noqa: E402
from linkax.model.sections import circle as circle  # noqa: E402
from linkax.model.sections import rectangle as rectangle  # noqa: E402
from linkax.model.shapes import Shape as Shape  # noqa: E402
from linkax.model.terms import Term as Term  # noqa: E402
from linkax.model.time_laws import PiecewiseLinear as PiecewiseLinear  # noqa: E402
from linkax.model.time_laws import Spline as Spline  # noqa: E402
from linkax.simulation.integrate.accuracy import BALANCED as BALANCED  # noqa: E402
from linkax.simulation.integrate.accuracy import DRAFT as DRAFT  # noqa: E402
from linkax.simulation.integrate.accuracy import PRECISE as PRECISE  # noqa: E402
from linkax.simulation.integrate.accuracy import Accuracy as Accuracy  # noqa: E402
from linkax.simulation.integrate.results import REMARKS as REMARKS  # noqa: E402
from linkax.simulation.integrate.results import RESULTS as RESULTS  # noqa: E402
from linkax.simulation.integrate.results import AccuracyWarning as AccuracyWarning  # noqa: E402
from linkax.simulation.integrate.results import SimulationError as SimulationError  # noqa: E402
from linkax.simulation.integrate.results import StiffnessWarning as StiffnessWarning  # noqa: E402
from linkax.simulation.integrate.rosenbrock import Rodas5P as Rodas5P  # noqa: E402
from linkax.simulation.integrate.runge_kutta import RungeKutta4 as RungeKutta4  # noqa: E402
from linkax.simulation.read.observables import Power as Power  # noqa: E402
from linkax.simulation.read.observables import Violation as Violation  # noqa: E402
from linkax.simulation.read.solution import Solution as Solution  # noqa: E402
from linkax.simulation.simulate import simulate as simulate  # noqa: E402
from linkax.simulation.start.assemblies import assemblies as assemblies  # noqa: E402
from linkax.simulation.start.assembly import AssemblyError as AssemblyError  # noqa: E402
from linkax.simulation.start.assembly import AssemblyWarning as AssemblyWarning  # noqa: E402
from linkax.simulation.start.assembly import assemble as assemble  # noqa: E402
from linkax.simulation.start.state import State as State  # noqa: E402
from linkax.studies.fits.design import design as design  # noqa: E402
from linkax.studies.fits.design_result import Design as Design  # noqa: E402
from linkax.studies.fits.fit import fit as fit  # noqa: E402
from linkax.studies.fits.fit_result import Fit as Fit  # noqa: E402
from linkax.studies.fits.fit_result import Starts as Starts  # noqa: E402
from linkax.studies.fits.profile import profile as profile  # noqa: E402
from linkax.studies.fits.profile_result import Profile as Profile  # noqa: E402
from linkax.studies.fits.shooting import Shots as Shots  # noqa: E402
from linkax.studies.fits.shooting import shoot as shoot  # noqa: E402
from linkax.studies.laboratory.experiments import Experiment as Experiment  # noqa: E402
from linkax.studies.laboratory.laboratory import Explained as Explained  # noqa: E402
from linkax.studies.laboratory.records import Channel as Channel  # noqa: E402
from linkax.studies.laboratory.records import Record as Record  # noqa: E402
from linkax.studies.laboratory.records import read_record as read_record  # noqa: E402
from linkax.studies.laboratory.sensors import AbstractSensor as AbstractSensor  # noqa: E402
from linkax.studies.laboratory.sensors import Encoder as Encoder  # noqa: E402
from linkax.studies.laboratory.sensors import ForceCell as ForceCell  # noqa: E402
from linkax.studies.laboratory.sensors import InertialUnit as InertialUnit  # noqa: E402
from linkax.studies.laboratory.sensors import Reading as Reading  # noqa: E402
from linkax.studies.laboratory.sensors import StrainGauge as StrainGauge  # noqa: E402
from linkax.studies.laboratory.sensors import Tracker as Tracker  # noqa: E402
from linkax.studies.parameters.differentiability import Differentiability as Differentiability  # noqa: E402
from linkax.studies.parameters.differentiability import differentiability as differentiability  # noqa: E402
from linkax.studies.parameters.parameters import Bounded as Bounded  # noqa: E402
from linkax.studies.parameters.parameters import Inertia as Inertia  # noqa: E402
from linkax.studies.parameters.parameters import LogNormal as LogNormal  # noqa: E402
from linkax.studies.parameters.parameters import Normal as Normal  # noqa: E402
from linkax.studies.parameters.parameters import PhysicalInertia as PhysicalInertia  # noqa: E402
from linkax.studies.parameters.parameters import Positive as Positive  # noqa: E402
from linkax.studies.sweeps.comparison import Stepping as Stepping  # noqa: E402
from linkax.studies.sweeps.comparison import compare as compare  # noqa: E402
from linkax.studies.sweeps.comparison_result import Comparison as Comparison  # noqa: E402
from linkax.studies.sweeps.comparison_result import Trial as Trial  # noqa: E402
from linkax.studies.sweeps.sweep import sweep as sweep  # noqa: E402
from linkax.studies.sweeps.sweep_result import Sweep as Sweep  # noqa: E402
from linkax.studies.synthesis.synthesis import synthesis as synthesis  # noqa: E402
from linkax.studies.synthesis.synthesis_result import Candidate as Candidate  # noqa: E402
from linkax.studies.synthesis.synthesis_result import Synthesis as Synthesis  # noqa: E402
from linkax.studies.tolerances.tolerance_analysis import tolerance_analysis as tolerance_analysis  # noqa: E402
from linkax.studies.tolerances.tolerance_result import SobolIndices as SobolIndices  # noqa: E402
from linkax.studies.tolerances.tolerance_result import Statistics as Statistics  # noqa: E402
from linkax.studies.tolerances.tolerance_result import ToleranceAnalysis as ToleranceAnalysis  # noqa: E402
from linkax.studies.tolerances.tolerance_result import ToleranceSamples as ToleranceSamples  # noqa: E402
from linkax.xla.program_cache import cache_programs as cache_programs  # noqa: E402

if _TYPE_CHECKING:
    from linkax import plot as plot
    from linkax.view import View as View
    from linkax.view import to_usd as to_usd

_LATER = {"plot": "linkax.plot", "View": "linkax.view", "to_usd": "linkax.view"}  # with matplotlib, or SciPy


def __getattr__(name: str) -> _Any:
    if name not in _LATER:
        raise AttributeError(f"module 'linkax' has no attribute {name!r}")
    module = _import_module(_LATER[name])
    return getattr(module, name, module)


def __dir__() -> list[str]:
    here = [name for name, entry in globals().items() if not (name.startswith("_") or isinstance(entry, _Module))]
    return sorted({*here, *_LATER})


globals().update(explain_slips({name: entry for name, entry in globals().items() if name in __dir__()}))
del explain_slips, jax, watch_lapack, watch_memory_maps
__all__ = __dir__()  # pyright: ignore[reportUnsupportedDunderAll]
