"""Noise in experiments: how large it is, and how sure it leaves what is fitted."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Int

from linkax.studies.laboratory.experiments import (
    Experiment,
    Experiments,
    Noise,
    checked_experiments,
    predict,
)
from linkax.studies.laboratory.losses import Loss, as_square, influence, spread
from linkax.studies.laboratory.sensors import AbstractSensor
from linkax.studies.laboratory.whiteness import Whiteness
from linkax.studies.parameters.uncertainty import Scatter, leverages
from linkax.xla.users_line import warn

FEWEST = 10  # samples of a channel that tell how much is explained
HARDLY = 0.1  # part of the variance up to which hardly any is explained
WORSE = -0.5  # the same, from which on no noise explains that the mean would be better
CORRELATED = 1e-3  # probability that noise is as correlated as what is left, below which it is none
TELLING = 0.05  # mean curvature of a robust loss, above which it tells how sure a fit is
FITTED = "with the fitted parameters"
LEAST = 1e-9  # noise relative to the largest measurement, below which it is rounding


class Errors(NamedTuple):
    """Predicted less measured numbers, in the order of the rows of a residual.

    - `values`: NaN where a sample is missing, (n,). `groups`: index of each in `names`.
    - `names`: (channel, component), of all experiments together.
    """

    values: Float[np.ndarray, " n"]
    groups: Int[np.ndarray, " n"]
    names: list[tuple[str, int]]

    @property
    def there(self) -> np.ndarray:
        """Which samples are not missing, (n,)."""
        return ~np.isnan(self.values)

    def of(self, group: int) -> np.ndarray:
        """Which are of a group, and not missing, (n,)."""
        return self.there & (self.groups == group)


class Worth(NamedTuple):
    """What rows of a residual are worth.

    - `factors`: of their sensitivities, for whose squares to be the curvature of the loss, (n,); with missing samples.
    - `scatter`: of the rows, without missing samples.
    """

    factors: Float[np.ndarray, " n"]
    scatter: Scatter


class Explained(NamedTuple):
    """How much a model explains of what was measured in one component of a channel, standard deviations all.

    - `noise`: as the sensor gives it, or as found. `left`: of predicted less measured. `measured`: about its mean.
    - `is_white`: whether what is left may be noise, without correlation from one sample to the next.

    With a robust loss, outliers count less here, too.
    """

    noise: float
    left: float
    measured: float
    is_white: bool

    @property
    def share(self) -> float:
        """Part of the variance that is explained; below zero where the mean would explain more, NaN of a constant."""
        return 1.0 - (self.left / self.measured) ** 2 if self.measured > 0.0 else float("nan")

    @property
    def is_nothing(self) -> bool:
        """Whether hardly anything is explained of what is no noise alone."""
        return self.share < WORSE or (self.share < HARDLY and not self.is_white)


class Laboratory(NamedTuple):
    """Experiments, and what is known of their noise, outside of programs.

    - `experiments`: the list. `together`: as one residual. `sensors`: of each, by channel, at some parameters.
    """

    experiments: list[Experiment]
    together: Experiments
    sensors: list[dict[str, AbstractSensor]]

    @staticmethod
    def of(experiments: Experiment | Sequence[Experiment], params: Any) -> "Laboratory":
        """Read one experiment or a list of them, at parameters.

        **Raises:** `ValueError` for entries that are no experiments, and where the noise of a sensor is a parameter.
        """
        found = checked_experiments(experiments)
        for each in filter(lambda each: callable(each.sensors), found):
            jax.eval_shape(partial(_check_noise, each), params)
        return Laboratory(found, Experiments.of(found), [each.sensors_at(params) for each in found])

    @property
    def by_channel(self) -> dict[str, AbstractSensor]:
        """The first sensor of each channel.

        **Raises:** `ValueError` where others differ in loss, in number of components, or in whether noise is known.
        """
        first: dict[str, tuple[int, AbstractSensor]] = {}
        each = ((place, name, sensor) for place, sensors in enumerate(self.sensors) for name, sensor in sensors.items())
        for place, name, sensor in each:
            before, other = first.setdefault(name, (place, sensor))
            if (sensor.loss, sensor.noise is None) != (other.loss, other.noise is None):
                raise ValueError(
                    f"sensors of channel {name!r} differ in their loss, or in whether their noise is known; give the "
                    "channels different names"
                )
            shape, expected = (self.experiments[i].record[name].values.shape[1:] for i in (place, before))
            if shape != expected:
                told = lambda shape: f"{shape[0]} numbers" if shape else "one number"
                raise ValueError(
                    f"channel {name!r} tells {told(shape)} in experiment {place}, and {told(expected)} in experiment "
                    f"{before}; give the channels different names"
                )
        return {name: sensor for name, (_, sensor) in first.items()}

    @property
    def finds_noise(self) -> bool:
        """Whether a sensor does not give its noise."""
        return any(sensor.noise is None for sensor in self.by_channel.values())

    def _rows(self, of_channel) -> np.ndarray:
        """Numbers of all channels, in the order of the rows; of_channel: (experiment's index, name) -> array."""
        return np.concatenate(
            [np.ravel(of_channel(i, name)) for i, each in enumerate(self.sensors) for name in sorted(each)]
        )

    def predict(self, params: Any, where: str) -> list[dict[str, np.ndarray]]:
        """What the sensors would tell, by channel of each experiment; `where` these parameters are, for errors.

        **Raises:** `ValueError` where a prediction of what was measured is not finite, with the reason.
        """
        predicted = self._predicted(params)
        if (bad := self._not_finite(predicted)) is not None:
            raise ValueError(self._reason(*bad, params, where))
        return predicted

    def _predicted(self, params) -> list[dict[str, np.ndarray]]:
        return jax.tree.map(np.asarray, predict(self.together, params))

    def _not_finite(self, predicted) -> tuple[int, str] | None:
        """The first experiment and channel of which a prediction of what was measured is not finite."""
        for place, (experiment, found) in enumerate(zip(self.experiments, predicted, strict=True)):
            for name, values in found.items():
                if not np.all(np.isfinite(values) | np.isnan(experiment.record[name].values)):
                    return place, name
        return None

    def errors(self, params: Any, where: str) -> Errors:
        """What predictions are off.

        **Raises:** as `predict`.
        """
        return self._errors(self.predict(params, where))

    def _errors(self, predicted) -> Errors:
        measured = lambda i, name: np.asarray(self.experiments[i].record[name].values)
        values = self._rows(lambda i, name: predicted[i][name] - measured(i, name))
        missing = np.isnan(self._rows(measured))
        sizes = {
            name: max(np.shape(measured(i, name))[1:], default=1)
            for i, each in enumerate(self.sensors)
            for name in each
        }
        names = [(name, component) for name, size in sizes.items() for component in range(size)]
        index = lambda i, name: np.broadcast_to(
            np.reshape([names.index((name, part)) for part in range(sizes[name])], measured(i, name).shape[1:]),
            measured(i, name).shape,
        )
        return Errors(np.where(missing, np.nan, values), self._rows(index), names)

    def _reason(self, place, name, params, where) -> str:
        """Why a prediction is not finite, found without programs."""
        experiment = self.experiments[place]
        which = f"channel {name!r}" + (f" of experiment {place}" if len(self.experiments) > 1 else "")
        try:
            solution = experiment.model(params, *experiment.args)
            experiment.sensors_at(params)[name].predict(solution, experiment.record[name].ts)
        except Exception as error:
            return f"{which} cannot be predicted {where}: {error}"
        return f"{which} is not predicted to be finite {where}; look at the solution of its model"

    def noise(self, errors: Errors, lost: Float[np.ndarray, " n"] | None = None) -> Noise:
        """Estimate the noise of sensors that give none, by channel.

        Of squares, in turn with a fit, this is restricted maximum likelihood (Patterson and Thompson, Recovery of
        inter-block information when block sizes are unequal, 1971).

        **Arguments:** `lost`: of each row, the part of a measurement that parameters were fitted to; see `lost`.
        """
        found, largest = {}, self._rows(lambda i, name: np.abs(self.experiments[i].record[name].values))
        lost = np.zeros_like(errors.values) if lost is None else lost
        for name, sensor in self.by_channel.items():
            if sensor.noise is not None:
                continue
            each = [
                max(
                    _share(lost[rows]) * spread(sensor.loss, errors.values[rows]),
                    LEAST * np.max(largest[rows]),
                    np.finfo(float).tiny,
                )
                for group, (channel, _) in enumerate(errors.names)
                if channel == name
                for rows in [errors.of(group)]
            ]
            shape = next(
                np.shape(each.record[name].values)[1:] for each in self.experiments if name in each.record.channels
            )
            found[name] = np.reshape(each, shape)
        return found

    def explained(self, errors: Errors, noise: Noise) -> dict[str, Explained]:
        """How much predictions explain, by channel, "name[0]" and so on where it tells several numbers."""
        values = self._rows(lambda i, name: np.asarray(self.experiments[i].record[name].values))
        places = self._rows(lambda i, name: np.full(np.shape(self.experiments[i].record[name].values), i))
        deviations, found = self._deviations(noise), {}
        for group, (name, component) in enumerate(errors.names):
            rows, loss = errors.of(group), self.by_channel[name].loss
            if np.sum(rows) < FEWEST:
                continue
            left = spread(loss, errors.values[rows])
            measured = values[rows] - (np.mean if loss == "squares" else np.median)(values[rows])
            series = [errors.values[(errors.groups == group) & (places == i)] for i in np.unique(places[rows])]
            whiteness = [Whiteness.of(influence(loss, each / left).first) for each in series if left > 0.0]
            is_white = all(each is None or each.probability > CORRELATED for each in whiteness)
            several = (name, 1) in errors.names
            key = f"{name}[{component}]" if several else name
            found[key] = Explained(float(deviations[rows][0]), left, spread(loss, measured), is_white)
        return found

    def first_noise(self, starts: Sequence[Any]) -> Noise:
        """The noise at the likeliest of several parameters; those whose predictions are not finite do not count.

        **Raises:** as `predict`, where that are all.
        """
        predicted = [self._predicted(params) for params in starts]
        errors = [self._errors(each) for each in predicted if self._not_finite(each) is None]
        errors = errors or [self.errors(starts[0], "where the fit starts")]
        noises = [self.noise(each) for each in errors]
        costs = [self._cost(*each) for each in zip(errors, noises, strict=True)]
        return noises[int(np.argmin(costs))]

    def _cost(self, errors, noise) -> float:
        """Negative logarithm of the likelihood, but for a constant."""
        deviations = self._deviations(noise)
        u, squares = errors.values / deviations, 0.0
        for group, (name, _) in enumerate(errors.names):
            squares += float(np.sum(as_square(self.by_channel[name].loss, u[errors.of(group)]) ** 2))
        return 0.5 * squares + float(np.sum(np.log(deviations[errors.there])))

    def lost(self, errors: Errors, noise: Noise, slopes: Float[np.ndarray, "m p"]) -> Float[np.ndarray, " n"]:
        """Of each row, the part of a measurement that parameters were fitted to, and that tells of no noise.

        These are the leverages of the rows, with which priors and all channels compete for the parameters.

        **Arguments:** `slopes`: of the residual in units of `noise`, and of priors.
        """
        found = self._influences(errors, noise)
        return leverages(_weighed(found.factors, slopes))[: len(errors.values)]

    def _influences(self, errors, noise) -> "_Influences":
        """What the losses make of the rows."""
        u, factors, silent = errors.values / self._deviations(noise), np.ones_like(errors.values), []
        ratios = np.ones_like(u)
        for group, loss in self._robust(errors).items():
            rows = errors.of(group)
            of_square, first, second = influence(loss, u[rows])
            if np.mean(second) > TELLING:
                factors[rows] = np.sqrt(np.mean(second)) / of_square
                ratios[rows] = np.mean(first**2) / np.mean(second)
            else:
                factors[rows] = 0.0
                silent.append(group)
        return _Influences(u, factors, ratios, silent)

    def _deviations(self, noise) -> np.ndarray:
        """Noise of all rows."""
        return self._rows(
            lambda i, name: np.broadcast_to(
                noise[name] if self.sensors[i][name].noise is None else self.sensors[i][name].noise,
                np.shape(self.experiments[i].record[name].values),
            )
        )

    def _robust(self, errors) -> dict[int, Loss]:
        """Groups whose loss is not that of squares, and theirs."""
        losses: dict[int, Loss] = {group: self.by_channel[name].loss for group, (name, _) in enumerate(errors.names)}
        return {group: loss for group, loss in losses.items() if loss != "squares"}

    def worth(self, errors: Errors, noise: Noise, slopes: Float[np.ndarray, "m p"]) -> Worth:
        """What the rows of the residual are worth.

        The estimate is an M-estimate: with ψ the derivative of the loss by u, the residual in units of the noise, and j
        that of u by the parameters, its covariance is A⁻¹ B A⁻¹ with A = Σ E[ψ′] jᵀj and B = Σ E[ψ²] jᵀj (Huber, Robust
        Statistics, 1981, chapter 7). Expectations are means over each component of a channel; over all channels for
        squares, whose noise may be known but for a factor.

        **Arguments:** `slopes`: as in `lost`.
        """
        u, factors, ratios, silent = self._influences(errors, noise)
        lost, robust = leverages(_weighed(factors, slopes))[: len(u)], self._robust(errors)
        for group in silent:
            warn(
                f"most residuals of channel {errors.names[group][0]!r} are beyond its noise, so that its loss "
                f"{robust[group]!r} tells nothing of how sure the fit is, and the channel does not count there; give a "
                "larger noise, or None, or look whether the model can give these data"
            )
        squares = errors.there & ~np.isin(errors.groups, list(robust))
        counted, loss = (squares, "squares") if np.any(squares) else (errors.there, "huber")
        factor = _share(lost[counted]) * spread(loss, u[counted])
        variances = np.full_like(u, factor**2)
        for group in robust:
            rows = errors.of(group)
            variances[rows] = _share(lost[rows]) ** 2 * ratios[rows]
        return Worth(factors, Scatter(factor, variances[errors.there]))


class _Influences(NamedTuple):
    """What losses make of rows.

    - `u`: residuals in units of the noise, (n,). `factors`: see `Worth`.
    - `ratios`: E[ψ²] / E[ψ′], see `Laboratory.worth`. `silent`: groups beyond whose noise most residuals are.
    """

    u: Float[np.ndarray, " n"]
    factors: Float[np.ndarray, " n"]
    ratios: Float[np.ndarray, " n"]
    silent: list[int]


def _weighed(factors, slopes):
    """Slopes of all rows, and of priors, with the factors of the losses."""
    return np.concatenate([factors[:, None] * slopes[: len(factors)], slopes[len(factors) :]])


def _check_noise(experiment, params) -> None:
    """Raise a ValueError where the noise of a sensor is a parameter."""
    for name, sensor in experiment.sensors_at(params).items():
        if isinstance(sensor.noise, Tracer):
            raise ValueError(
                f"the noise of channel {name!r} is a parameter, which a fit would make infinite; leave it None, and "
                "the fit finds it"
            )


def _share(lost) -> float:
    """By how much noise is larger than what a fit leaves of it; of the rows of a group."""
    return float(np.sqrt(len(lost) / max(len(lost) - np.sum(lost), 1.0)))
