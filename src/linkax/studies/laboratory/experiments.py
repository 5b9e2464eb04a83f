"""Experiments: a model, what instruments would tell of it, and what they told."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import require_type
from linkax.simulation.read.solution import Solution
from linkax.studies.laboratory.losses import EFFICIENCY, as_square
from linkax.studies.laboratory.records import Record
from linkax.studies.laboratory.sensors import AbstractSensor
from linkax.studies.parameters.parameters import as_arrays
from linkax.xla.arrays import Array

Noise = dict[str, Float[Array, "..."]]


class Experiment(eqx.Module):
    """A model, the sensors that watch it, and the record of what they told.

    `linkax.fit` takes an experiment, or a list of them, in place of a function. Its residual is (predicted − measured)
    / noise of all channels, through the sensors' losses; missing samples do not count.

    **Arguments:**

    - `model`: (params, *args) -> a `Solution` whose saved times span those of the record, less the delays. Between
      them the motion is interpolated, see `Solution.at`; 20 times a period of the fastest motion are enough.
    - `record`: a `Record`, or {channel: (ts, values)}.
    - `sensors`: {channel: sensor}, see `linkax.AbstractSensor`; or a function (params, *args) -> the same, where gains,
      biases or delays are parameters. Channels of the record without sensor are left out. Noise that no sensor gives
      is found by the fit, one for all channels of a name.
    - `args`: further arguments of model and sensors, numbers and arrays that are this experiment's own: a measured
      load, or the index of its initial state among the parameters. Experiments with the same model and sensors, and
      records of the same shapes, are computed as one batch.

    For `linkax.design`, model and sensors get the design as one more argument, (params, design, *args), all sensors
    have a noise, and of the values of the record only those that are missing count.

    **Raises:** `ValueError` for arguments of other kinds, and a sensor without channel.
    """

    model: Callable
    record: Record
    sensors: Any
    args: tuple

    def __init__(
        self,
        model: Callable,
        record: Record | Mapping[str, Any],
        sensors: Mapping[str, AbstractSensor] | Callable,
        args: tuple | list = (),
    ) -> None:
        self.model = require_type(model, Callable, "model", "give a function (params, *args) -> a linkax.Solution")
        self.record = record if isinstance(record, Record) else Record(record)
        require_type(sensors, Mapping | Callable, "sensors", "give {channel: sensor}, or a function that returns that")
        self.sensors = sensors if callable(sensors) else self._checked(sensors)
        require_type(args, list | tuple, "args", "give a tuple of what else the model gets")
        self.args = as_arrays(tuple(args), "args")

    def _checked(self, sensors) -> dict[str, AbstractSensor]:
        require_type(sensors, Mapping, "sensors", "give {channel: sensor}")
        if not sensors:
            raise ValueError("an experiment has no sensors; give {channel: sensor}")
        for name, sensor in sensors.items():
            _ = self.record[name]
            require_type(sensor, AbstractSensor, f"sensor of channel {name!r}", "give one such as linkax.Encoder(...)")
        return dict(sensors)

    def sensors_at(self, params: Any) -> dict[str, AbstractSensor]:
        """The sensors, by channel, at parameters."""
        return self._checked(self.sensors(params, *self.args)) if callable(self.sensors) else self.sensors

    def predict(self, params: Any) -> dict[str, Float[Array, "n ..."]]:
        """What the sensors would tell at the times of the record, without noise, by channel; (n,) or (n, k)."""
        return _predicted(self, params, self.sensors_at(params))

    def residual(self, params: Any, noise: Noise) -> dict[str, Float[Array, "n ..."]]:
        """What `linkax.fit` minimises the squares of, by channel; zero where a sample is missing.

        **Arguments:** `noise`: {channel: standard deviation} of the sensors that give none.
        """
        sensors, rows = self.sensors_at(params), {}
        for name, predicted in _predicted(self, params, sensors).items():
            sensor, values = sensors[name], self.record[name].values
            missing = jnp.isnan(values)
            apart = jnp.where(missing, 0.0, predicted - jnp.where(missing, 0.0, values))
            rows[name] = as_square(sensor.loss, apart / (noise[name] if sensor.noise is None else sensor.noise))
        return rows

    def planned(self, params: Any, design: Any) -> dict[str, Float[Array, "n ..."]]:
        """What `linkax.design` gets, by channel: predictions over the noise; zero where a sample is missing.

        Where errors are normal, a robust loss leaves 95 % of what measurements tell.

        **Raises:** `ValueError` for a sensor without noise.
        """
        own = dataclasses.replace(self, args=(design, *self.args))
        # Information is that of the mean: noise that depends on parameters tells nothing of them here.
        rows, of_noise = {}, own.sensors_at(jax.lax.stop_gradient(params))
        for name, predicted in _predicted(own, params, own.sensors_at(params)).items():
            noise, share = of_noise[name].noise, EFFICIENCY[of_noise[name].loss]
            if noise is None:
                raise ValueError(f"the sensor of channel {name!r} has no noise, which a design needs; give it one")
            rows[name] = jnp.where(jnp.isnan(self.record[name].values), 0.0, np.sqrt(share) * predicted / noise)
        return rows


def _predicted(experiment, params, sensors) -> dict[str, Array]:
    solution = experiment.model(params, *experiment.args)
    require_type(solution, Solution, "what a model returned", "let it return a linkax.Solution")
    times = {name: sensor.times(jnp.asarray(experiment.record[name].ts)) for name, sensor in sensors.items()}
    motion, first, found = solution.at(jnp.concatenate(list(times.values()))), 0, {}
    for name, sensor in sensors.items():
        own = slice(first, first := first + len(times[name]))
        part = dataclasses.replace(motion, ts=motion.ts[own], q=motion.q[own], v=motion.v[own])
        found[name], values = sensor.told(part, solution), experiment.record[name].values
        if found[name].shape != values.shape:
            raise ValueError(
                f"channel {name!r} has values of shape {values.shape}, and {type(sensor).__name__} tells "
                f"{found[name].shape}; choose with components=, or take another sensor"
            )
    return found


class Experiments(eqx.Module):
    """Experiments as one residual: (params, noise) -> for each, by channel, what `Experiment.residual` returns.

    - `members`: for each kind, its experiments, stacked where there are several. `places`: of these in the list.
    """

    members: list[Experiment]
    places: list[tuple[int, ...]] = eqx.field(static=True)

    @staticmethod
    def of(experiments: Sequence[Experiment]) -> "Experiments":
        """Put those of a kind together, which `checked_experiments` has checked."""
        kinds: dict[int, list[int]] = {}
        for place, experiment in enumerate(experiments):
            alike = next((first for first in kinds if _are_alike(experiments[first], experiment)), place)
            kinds.setdefault(alike, []).append(place)
        members = [_stacked([experiments[place] for place in places]) for places in kinds.values()]
        return Experiments(members, [tuple(places) for places in kinds.values()])

    def _of_each(self, function: Callable[[Experiment], Any]) -> list[Any]:
        found = {}
        for member, places in zip(self.members, self.places, strict=True):
            if len(places) == 1:
                found[places[0]] = function(member)
                continue
            together = eqx.filter_vmap(function, in_axes=(eqx.if_array(0),))(member)
            for index, place in enumerate(places):
                found[place] = jax.tree.map(lambda array, index=index: array[index], together)
        return [found[place] for place in sorted(found)]

    def __call__(self, params: Any, noise: Noise) -> list[dict[str, Array]]:
        return self._of_each(lambda experiment: experiment.residual(params, noise))

    def predict(self, params: Any) -> list[dict[str, Array]]:
        """Of each experiment, see `Experiment.predict`."""
        return self._of_each(lambda experiment: experiment.predict(params))

    def planned(self, params: Any, design: Any) -> list[dict[str, Array]]:
        """Of each experiment, see `Experiment.planned`."""
        return self._of_each(lambda experiment: experiment.planned(params, design))


def checked_experiments(experiments: Experiment | Sequence[Experiment]) -> list[Experiment]:
    """One experiment or several as a list.

    **Raises:** `ValueError` for entries that are no experiments, and where there are none.
    """
    remedy = "give linkax.Experiment(model, record, sensors)"
    found = [experiments] if isinstance(experiments, Experiment) else list(experiments)
    for each in found:
        require_type(each, Experiment, "an entry of the experiments", remedy)
    if not found:
        raise ValueError(f"there are no experiments in the list; {remedy}")
    return found


def _are_alike(one, other) -> bool:
    """Whether experiments differ in the numbers of their arrays alone."""
    (arrays, static), (others, static_of_other) = (eqx.partition(each, eqx.is_array) for each in (one, other))
    kind = lambda tree: jax.tree.map(lambda array: jax.ShapeDtypeStruct(array.shape, array.dtype), tree)
    return bool(eqx.tree_equal(kind(arrays), kind(others))) and bool(eqx.tree_equal(static, static_of_other))


def _stacked(experiments):
    if len(experiments) == 1:
        return experiments[0]
    arrays, static = zip(*(eqx.partition(each, eqx.is_array) for each in experiments), strict=True)
    return eqx.combine(jax.tree.map(lambda *parts: np.stack(parts), *arrays), static[0])


predict = eqx.filter_jit(lambda experiments, params: experiments.predict(params))
