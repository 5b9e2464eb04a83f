"""The result of a fit, and how sure its parameters are."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from linkax.model.numbers import require_type, whole_number
from linkax.studies.laboratory.experiments import Experiment
from linkax.studies.laboratory.laboratory import FITTED, Explained, Laboratory
from linkax.studies.parameters.uncertainty import Spread
from linkax.tables import Rows, Table, count, known, numbers, one, printed_as
from linkax.xla.arrays import Array

ROUNDING = 1e-9  # standard error of a number relative to its start, up to which no measurement can be meant
EXACT = "exact but for rounding, so that standard errors tell of no noise"


def is_exact(fit: "Fit") -> bool:
    """Whether a residual is but rounding: that of data without noise, or of no more data than numbers."""
    return fit.spread is not None and bool(np.all(fit.spread.deviation <= ROUNDING))


def _table(fit: "Fit") -> Table:
    title = f"Fit: {fit.ended} after {count(fit.steps, 'step')}, loss {numbers(fit.loss)}"
    title += "" if fit.noise is None else f", noise {numbers(fit.noise)}"
    title += f"; {EXACT}" if is_exact(fit) else ""
    values = np.concatenate([np.ravel(known(leaf)) for leaf in jax.tree.leaves(fit.params)])
    spreads = [None] * len(values) if fit.covariance is None else np.sqrt(np.diagonal(np.asarray(fit.covariance)))
    rows = [
        (name, numbers(value), "" if spread is None or np.isnan(spread) else numbers(spread), remark_on(fit, name))
        for name, value, spread in zip(fit.names, values, spreads, strict=True)
    ]
    head = "channel", "noise", "left", "measured", "explained"
    channels = [
        (name, one(of.noise), one(of.left), one(of.measured), "" if np.isnan(of.share) else f"{max(of.share, 0.0):.1%}")
        for name, of in fit.channels.items()
    ]
    parts = [Rows(("parameter", "value", "standard error", ""), rows, "parameters")]
    return Table(title, parts + [Rows(head, channels, "channels")] * bool(channels))


def remark_on(fit: "Fit", name: str) -> str:
    """What there is to say of a number."""
    if name in fit.on_bound:
        return f"on its {fit.on_bound[name]} bound"
    return "not determined by the data" if name in fit.undetermined else ""


def doubts(fit: "Fit") -> list[str]:
    """What there is to say of channels, and of bounds."""
    told = [
        f"the model does not explain channel {name!r}: it leaves a standard deviation of {one(channel.left)}, and what "
        f"was measured has {one(channel.measured)}; look whether units, signs and axes of the record are those of the "
        "model"
        for name, channel in fit.channels.items()
        if channel.is_nothing
    ]
    if fit.on_bound:
        names = ", ".join(f"{name!r} (the {side} one)" for name, side in fit.on_bound.items())
        told.append(
            f"the best value lies on a bound, or beyond it, of {names}: it has no standard error, and others are as "
            "sure as told only if the bound is right; widen it, or look whether model and data fit to each other"
        )
    return told


class Starts(NamedTuple):
    """Where the searches from several starts led.

    - `params`: with one axis more, of the n starts. `losses`: (n,), infinite where a search could not begin.
    - `ended`: how each ended, see `Fit`.
    """

    params: Any
    losses: np.ndarray
    ended: list[str]


@printed_as(_table)
class Fit(NamedTuple):
    """The parameters of a fit, their covariance, and how the fit ended.

    - `params`: fitted numbers, in the structure of the initial `params`, with plain numbers in place of `Positive`,
      `Normal` and their like.
    - `loss`: the loss, or half the sum of squares of the residual, with those of priors. `residual`: at `params`, (n,),
      without priors and missing samples; None for a loss.
    - `names`: of the p numbers in `params`, in the order of `covariance`.
    - `covariance`: of these numbers, (p, p), estimated from the sensitivities of the residual and its size. Infinite
      for numbers that the data do not determine; None for a loss, and where the fit ended at an edge, without
      derivative or without a better step. `noise`: standard deviation of the residual, None likewise; of experiments in
      units of the noise that sensors give, or that was found.
    - `undetermined`: names of the numbers that the data do not determine; of a loss, of those along which it has no
      slope where the fit starts, unless it rises aside from there.
    - `on_bound`: {name: "lower" or "upper"} of the numbers that lie on a bound, beyond which the loss would fall
      further, or, of a loss, within 1e-4 of the range from it. They have no standard error: their covariance is NaN,
      and that of other numbers is as if they were known. Of a `PhysicalInertia` it has the parameter's own name, where
      a body has no mass or no extent along some axis.
    - `history`: {"loss": at each step, where noise is found in units of that found so far}. `steps`: number of steps.
    - `ended`: "converged", "stopped early", "diverged", or "out of steps"; "at an edge", where the loss would fall
      further but the function is not finite there; "no derivative", where the function is finite and its derivative is
      not; "no better step", where it ended although the loss has a slope.
    - `spread`: level of confidence -> ends of the intervals; None where `covariance` is.
    - `experiments`: those that were fitted, none for a function. `noises`: {channel: standard deviation} of what their
      sensors tell, where these do not give it.
    - `channels`: {channel: `Explained`} of the experiments, of those of ten samples or more: `noise` beside the
      standard deviations of what the model leaves, and of what was measured, and the `share` of variance that is
      explained. Of several components, "name[0]", "name[1]", ….
    - `starts`: `Starts`, where there were several.
    """

    params: Any
    loss: float
    residual: np.ndarray | Any
    names: list[str]
    covariance: np.ndarray | Any
    noise: float | None
    undetermined: list[str]
    on_bound: dict[str, str]
    history: dict[str, np.ndarray]
    steps: int
    ended: str
    spread: Spread | None
    channels: dict[str, Explained]
    experiments: tuple[Experiment, ...] = ()
    noises: dict[str, np.ndarray] | None = None
    starts: Starts | None = None

    @property
    def standard_errors(self) -> Any:
        """Standard deviation of each number, in the structure of `params`.

        **Raises:** `ValueError` for a fit without covariance.
        """
        if self.covariance is None:
            raise self._no_covariance()
        _, unravel = ravel_pytree(self.params)
        return jax.tree.map(np.asarray, unravel(jnp.sqrt(jnp.diagonal(self.covariance))))

    def interval(self, level: float = 0.95) -> tuple[Any, Any]:
        """Lower and upper ends of the confidence intervals of all numbers, each in the structure of `params`.

        They follow from Student's t distribution, and end at the bounds of `Positive` and `Bounded` at the latest. Of a
        number that is on a bound, the interval reaches from there to where the likelihood has fallen as much, when the
        residual is linear; `linkax.profile` tells without that.

        **Raises:** `ValueError` for a fit without covariance, and for a level that is not between 0 and 1.
        """
        spread = self.determined()
        if not 0.0 < level < 1.0:
            raise ValueError(f"level is {level!r}; it must lie between 0 and 1, such as 0.95")
        return spread(level)

    def sample(self, key: Array, count: int) -> Any:
        """Draw parameters from Laplace's approximation of their posterior, for predictions with their uncertainty.

        The free numbers are normal about the fit, with its covariance, as from their priors, which are flat but for
        those of `Normal` and `LogNormal`, and within the bounds of `Positive` and `Bounded`. Numbers that lie on a
        bound stay there.

        **Arguments:** `key`: of `jax.random`. `count`: number of draws.

        **Returns:** parameters in the structure of `params`, with a leading axis of draws.

        **Raises:** `ValueError` for a fit without covariance, and for one of parameters that the data do not determine.
        """
        spread = self.determined()
        if not np.all(np.isfinite(spread.deviation[spread.sides == 0])):
            raise ValueError(
                f"the data do not determine {', '.join(map(repr, self.undetermined))}, so no draws can be made; fix "
                "some, or add what is known of them to the residual"
            )
        return spread.draws(key, whole_number(count, "count"))

    def determined(self) -> Spread:
        """How far from the fit parameters may be.

        **Raises:** `ValueError` for a fit without covariance.
        """
        if self.spread is None:
            raise self._no_covariance()
        return self.spread

    def predict(self, experiments: Experiment | Sequence[Experiment] | None = None) -> list[dict[str, np.ndarray]]:
        """What sensors would tell without noise, {channel: (n,) or (n, k)} of each experiment.

        **Arguments:** `experiments`: by default those that were fitted; give others to see how well they are predicted.

        **Raises:** `ValueError` for a fit of a function without `experiments`, and where the prediction of a sample is
        not finite, as of records that reach beyond the saved times of the model's run.
        """
        if experiments is None and not self.experiments:
            raise ValueError(
                "this is the fit of a function, which has no sensors; call it with fit.params, or give experiments"
            )
        given = self.experiments if experiments is None else experiments
        return Laboratory.of(given, self.params).predict(self.params, FITTED)

    def report(self, path: str | os.PathLike, held_out: Experiment | Sequence[Experiment] = ()) -> Path:
        """Write a report as one HTML file, which needs no network.

        It has the parameters with their intervals, what is not determined, covariance and correlation; of each channel
        measured and predicted values, residuals, and whether these are white (Ljung and Box); the same of records held
        out. Of a fit of a function it has the residual as a whole.

        **Arguments:** `path`: of the file. `held_out`: experiments that were not fitted.

        **Raises:** `ValueError` for a folder that cannot be written to, records that cannot be predicted, as `predict`
        does, and channels held out whose noise is not known.
        """
        from linkax.plot.fit_report import report

        path = Path(require_type(path, str | os.PathLike, "path", "give the name of a file"))
        return report(self, path, [held_out] if isinstance(held_out, Experiment) else list(held_out))

    def _no_covariance(self):
        return ValueError(
            f"this fit has no covariance, it ended {self.ended!r}: fit a residual, whose sum of squares is the "
            "loss, and start where steps lead to a minimum"
        )
