"""A run: what is to be integrated, how, and what is saved of it, checked once and carried whole."""

import dataclasses
from typing import Any, NamedTuple, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.formulations.formulation import AbstractFormulation
from linkax.formulations.named import formulation as named_formulation
from linkax.formulations.tangent_space import TangentSpace
from linkax.model.functions import Function
from linkax.model.mechanism import Mechanism
from linkax.model.numbers import Number, require_type
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.default_solver import default_solver
from linkax.simulation.integrate.discrete_adjoint import has_discrete_adjoint
from linkax.simulation.integrate.impacts import impacts_of
from linkax.simulation.integrate.options import (
    check_accuracy,
    check_kinds,
    check_saved_times,
    check_steps,
    floating,
    save_at,
    saves_times,
    traced_tolerances,
)
from linkax.simulation.integrate.step_control import MechanismControl
from linkax.simulation.start.state import State
from linkax.simulation.start.validation import checked_state, checked_time
from linkax.xla.arrays import Array, ScalarLike
from linkax.xla.tracing import all_concrete, concrete
from scalarjit import Flat, with_known_entries

DEFAULT_FORMULATION = TangentSpace()
DEFAULT_MAX_STEPS = 16**4
DEFAULT_SAVES = 201
SAVE_STATE = diffrax.SubSaveAt(t1=True).fn
Tree = TypeVar("Tree")


class DiffraxOptions(NamedTuple):
    """diffrax's own objects: how to step, what to save, how to differentiate."""

    dt0: Any
    solver: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController
    max_steps: int | None
    saveat: diffrax.SaveAt | None = None
    adjoint: diffrax.AbstractAdjoint | None = None
    event: diffrax.Event | None = None
    progress_meter: diffrax.AbstractProgressMeter | None = None


class Run(eqx.Module):
    """One run of a mechanism from a state at t0 to t1 [s], as `linkax.simulate` was asked for it.

    - `formulation`: of the equations of motion. `accuracy`: tolerances and projection.
    - `saves_times`: whether states are saved at given times, and nothing else.
    - `flat`: the mechanism; noted is which entries of its arrays programs may know.
    """

    flat: Flat[Mechanism]
    state: State
    t0: Float[Array, "*batch"] | float | np.floating
    t1: Float[Array, "*batch"] | float | np.floating
    formulation: AbstractFormulation
    accuracy: Accuracy
    saves_times: bool = eqx.field(static=True)
    _options: Flat[DiffraxOptions] | None

    @staticmethod
    def of(
        mechanism: Mechanism,
        state: State,
        *,
        t0: Number,
        t1: Number,
        accuracy: Accuracy,
        formulation: str | AbstractFormulation | None,
        dtype: Any,
        **given: Any,
    ) -> "Run":
        """Check all options of `linkax.simulate`, and fill in those that are None.

        **Raises:** `ValueError` for the first one that is wrong.
        """
        dtype, t0, t1 = floating(dtype), checked_time(t0, "t0"), checked_time(t1, "t1")
        if concrete(t0) is not None and concrete(t1) is not None and not t1 > t0:
            raise ValueError(f"t1 is {t1} s, t0 is {t0} s; t1 must be larger")
        state = checked_state(mechanism, state)
        check_accuracy(accuracy)
        check_kinds(**{name: entry for name, entry in given.items() if name not in ("dt0", "max_steps")})
        formulation = checked_formulation(formulation, accuracy)
        options = _filled_in(mechanism, state, accuracy, t0, t1, **given)
        if (stops := impacts_of(mechanism)) and not MechanismControl(options.controller).is_adaptive:
            raise ValueError(
                f"{stops[0].display_name} needs steps that end where an impact happens, and stepsize_controller is "
                f"{options.controller!r}; leave it out, or give a linkax.JointLimit or Contact in place of the impact"
            )
        flat = cast(with_known_entries(mechanism), dtype)
        state, t0, accuracy = cast((state, t0, accuracy), dtype)
        return Run(flat, state, t0, t1, formulation, accuracy, saves_times(options.saveat), Flat.of(options))

    @staticmethod
    def of_state(
        mechanism: Mechanism, state: State, t: ScalarLike, formulation: AbstractFormulation, accuracy: Accuracy
    ) -> "Run":
        """What a state alone says of a run: nothing is stepped."""
        return Run(with_known_entries(mechanism), state, t, t, formulation, accuracy, False, None)

    @property
    def mechanism(self) -> Mechanism:
        """What moves."""
        return self.flat.tree

    @property
    def is_integrated(self) -> bool:
        """False for what a state alone says of a run."""
        return self._options is not None

    @property
    def options(self) -> DiffraxOptions:
        """diffrax's objects."""
        options: Any = self._options
        return options.tree

    @property
    def control(self) -> MechanismControl:
        """The step control of a mechanism around diffrax's."""
        return MechanismControl(self.options.controller, is_undifferentiated=self.has_discrete_adjoint)

    @property
    def has_discrete_adjoint(self) -> bool:
        """Whether derivatives go over the accepted steps: the default where it can be."""
        options = self.options
        if options.adjoint is not None or options.saveat is None or not saves_states(options.saveat):
            return False
        return has_discrete_adjoint(options.solver, options.saveat, options.event, options.max_steps)

    @property
    def adjoint(self) -> diffrax.AbstractAdjoint:
        """How diffrax itself differentiates."""
        if self.options.adjoint is not None:
            return self.options.adjoint
        return diffrax.ForwardMode() if self.has_discrete_adjoint else diffrax.RecursiveCheckpointAdjoint()

    @property
    def tangent_space(self) -> TangentSpace:
        """What measures ranks and distances from singular configurations: the formulation, or the paper's."""
        return self.formulation if isinstance(self.formulation, TangentSpace) else DEFAULT_FORMULATION

    def changed(self, **changes: Any) -> "Run":
        """The same run with other fields, or other objects of diffrax."""
        options = {name: changes.pop(name) for name in DiffraxOptions._fields if name in changes}
        if "saveat" in options:
            changes["saves_times"] = saves_times(options["saveat"])
        return dataclasses.replace(self, **changes, _options=Flat.of(self.options._replace(**options)))

    def remembered(self) -> "Run":
        """What a solution keeps: to run it again, or a part of it, without the functions of a user."""
        dt0, solver, controller, max_steps, *_ = self.options
        return dataclasses.replace(self, _options=Flat.of(DiffraxOptions(dt0, solver, controller, max_steps)))


def checked_formulation(
    formulation: str | AbstractFormulation | None, accuracy: Accuracy | None = None
) -> AbstractFormulation:
    """Return the formulation of a name, or itself; the paper's with the deprecated numbers of `accuracy`.

    **Raises:** `ValueError` for an unknown name, for what is no formulation, and where an accuracy says something else.
    """
    given = DEFAULT_FORMULATION if formulation is None else formulation
    formulation = named_formulation(given) if isinstance(given, str) else given
    names = "give a name, linkax.TangentSpace() or a linkax.ClassicalFormulation"
    require_type(formulation, AbstractFormulation, "formulation", names)
    deprecated = None if accuracy is None else accuracy.tangent_space
    if deprecated is None or not isinstance(formulation, TangentSpace):
        return formulation
    if isinstance(given, TangentSpace) and given is not DEFAULT_FORMULATION:
        raise ValueError(
            "rank_tolerance or metric is given by linkax.Accuracy, and formulation is a linkax.TangentSpace, which has "
            "them too; give them to linkax.TangentSpace alone"
        )
    return deprecated


def _filled_in(mechanism, state, accuracy, t0, t1, *, solver, stepsize_controller, dt0, max_steps, saveat, **others):
    """`DiffraxOptions` with defaults in place of None."""
    if stepsize_controller is None:
        stepsize_controller = diffrax.PIDController(rtol=accuracy.rtol, atol=accuracy.atol)
    if solver is None:
        rtol, _ = MechanismControl(stepsize_controller).tolerances((None, None))
        solver = default_solver(mechanism, rtol, t1 - t0, state)
    dt0 = check_steps(solver, stepsize_controller, dt0, max_steps, t0, t1)
    if saveat is None:
        evenly = np.linspace if all_concrete((t0, t1)) else jnp.linspace
        saveat = save_at(evenly(t0, t1, DEFAULT_SAVES))
    check_saved_times(saveat, t0, t1, max_steps)
    saveat, others["event"] = _with_functions(saveat, others["event"])
    # Tolerances are arrays, so that another value compiles nothing anew.
    return DiffraxOptions(dt0, solver, traced_tolerances(stepsize_controller), max_steps, saveat, **others)


def saves_states(saveat: diffrax.SaveAt) -> bool:
    """Whether states are saved, and not functions of them."""
    return isinstance(saveat.subs, diffrax.SubSaveAt) and saveat.subs.fn is SAVE_STATE


def cast(tree: Tree, dtype: np.dtype) -> Tree:
    """A pytree with its numbers in a floating-point type; itself where they have it, with what is kept of it."""
    leaves, treedef = jax.tree.flatten(tree)
    real = lambda leaf: isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating)
    is_other = [real(leaf) and leaf.dtype != dtype for leaf in leaves]
    if not any(is_other):
        return tree
    found = [leaf.astype(dtype) if other else leaf for leaf, other in zip(leaves, is_other, strict=True)]
    return jax.tree.unflatten(treedef, found)


def _with_functions(saveat, event):
    """The same with their functions compared by what they compute, see `scalarjit.code`."""
    if event is not None:
        functions = jax.tree.map(lambda function: Function(function, "event"), event.cond_fn, is_leaf=callable)
        event = eqx.tree_at(lambda e: e.cond_fn, event, functions)
    if not saves_states(saveat):
        is_sub = lambda node: isinstance(node, diffrax.SubSaveAt)
        saveat = eqx.tree_at(lambda s: s.subs, saveat, jax.tree.map(_with_function, saveat.subs, is_leaf=is_sub))
    return saveat, event


def _with_function(sub):
    if sub.fn is SAVE_STATE or (function := Function(sub.fn, "saveat")).numbers:  # which diffrax takes for structure
        return sub
    return eqx.tree_at(lambda s: s.fn, sub, function)
