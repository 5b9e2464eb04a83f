"""Experiments: what fits find of motions, instruments and noise, and how sure they are of it."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.studies.laboratory.experiments import Experiments
from linkax.studies.laboratory.losses import as_square, influence

TIMES = np.arange(0.1, 1.9, 0.02)
TRUTH = {"gain": 1.05, "bias": 0.2, "delay": 0.013}
START = {"gain": 1.0, "bias": 0.0, "delay": 0.0}
NOISE = 0.01


def swing(start, saves=41):
    state = lx.State(jnp.reshape(start, 1), jnp.zeros(1))
    return lx.simulate(pendulum(), state, t1=2.0, saveat=diffrax.SaveAt(ts=np.linspace(0.0, 2.0, saves)))


@pytest.fixture(scope="module")
def motion():
    """A motion that is known: fits are of the instruments alone, and compile fast."""
    return swing(-0.6)


@pytest.fixture(scope="module")
def known(motion):
    return lambda params, *args: motion


def encoder(loss="squares", noise=None):
    return lambda params, *args: {"encoder": lx.Encoder("hinge", **params, loss=loss, noise=noise)}


SENSORS = {loss: encoder(loss) for loss in ("squares", "huber", "cauchy")}  # the same function compiles once


def exact(known, ts=TIMES):
    blank = {"encoder": (ts, np.zeros(len(ts)))}
    return np.asarray(lx.Experiment(known, blank, SENSORS["squares"]).predict(TRUTH)["encoder"])


def told(known, seed, outliers=0.0):
    draw, values = np.random.default_rng(seed), exact(known)
    noise = NOISE * draw.normal(size=values.shape)
    return values + np.where(draw.uniform(size=values.shape) < outliers, 30.0 * noise, noise)


def test_predictions_are_those_of_the_sensors(known, motion):
    late = motion.at(TIMES - TRUTH["delay"]).joint("hinge")
    np.testing.assert_allclose(exact(known), TRUTH["gain"] * late + TRUTH["bias"], rtol=1e-12)


def test_missing_samples_do_not_count(known):
    """As if they were not there."""
    values = told(known, 0)
    values[[3, 20, 21]] = np.nan
    left = ~np.isnan(values)
    holes, without = (
        lx.fit(lx.Experiment(known, {"encoder": channel}, SENSORS["squares"]), START)
        for channel in ((TIMES, values), (TIMES[left], values[left]))
    )
    np.testing.assert_allclose(holes.covariance, without.covariance, rtol=1e-6)
    for name in TRUTH:
        np.testing.assert_allclose(holes.params[name], without.params[name], rtol=1e-7)
    assert len(holes.residual) == len(TIMES) - 3
    np.testing.assert_allclose(holes.noises["encoder"], NOISE, rtol=0.2)
    np.testing.assert_allclose(holes.noise, 1.0, rtol=1e-2)


def test_noise_that_is_known_but_for_a_factor_gives_the_same(known):
    record = {"encoder": (TIMES, told(known, 0))}
    found = lx.fit(lx.Experiment(known, record, SENSORS["squares"]), START)
    given = lx.fit(lx.Experiment(known, record, encoder(noise=0.02)), START)
    np.testing.assert_allclose(found.covariance, given.covariance, rtol=1e-4)
    np.testing.assert_allclose(given.noise, found.noises["encoder"] / 0.02, rtol=1e-4)


@pytest.mark.parametrize("wrong", [np.degrees, np.negative, lambda angle: angle + 1.0, lambda angle: 0.0 * angle])
def test_a_channel_that_is_not_explained_is_told(known, motion, wrong):
    """Degrees for radians, another sign, an offset, nothing; not one that is explained, or has noise alone."""
    draw, noisy = np.random.default_rng(0), lambda values: values + NOISE * draw.normal(size=np.shape(values))
    tip = np.asarray(motion.at(TIMES).position("arm", at="tip"))
    angle = np.asarray(motion.at(TIMES).joint("hinge"))
    record = {"encoder": (TIMES, noisy(wrong(angle))), "camera": (TIMES, noisy(tip))}  # whose third number is zero
    sensors = lambda params: {
        "encoder": lx.Encoder("hinge", gain=params["gain"]),
        "camera": lx.Tracker("arm", "tip"),
    }
    with pytest.warns(UserWarning, match="does not explain channel 'encoder'") as told:
        found = lx.fit(lx.Experiment(known, record, sensors), {"gain": lx.Normal(1.0, 1e-3)})
    assert [word in str(told[0].message) for word in ("'encoder'", "camera")] == [True, False]
    assert len(told) == 1
    left, measured = found.predict()[0]["encoder"] - record["encoder"][1], np.std(record["encoder"][1])
    encoder = found.channels["encoder"]
    np.testing.assert_allclose([encoder.left, encoder.measured], [np.sqrt(np.mean(left**2)), measured], rtol=1e-9)
    np.testing.assert_allclose(encoder.share, 1.0 - np.mean(left**2) / measured**2, rtol=1e-9)
    assert found.channels["camera[0]"].share > 0.99
    assert abs(found.channels["camera[2]"].share) < 0.1
    assert f"{encoder.measured:.6g}" in str(found)


def two_encoders(params):
    own = {"gain": params["gain"], "bias": params["own bias"]}
    return {"few": lx.Encoder("hinge", **own), "many": lx.Encoder("hinge", bias=params["bias"])}


def two_records(motion):
    draw, exact = np.random.default_rng(0), np.asarray(motion.at(TIMES).joint("hinge"))
    chosen = np.linspace(0, len(TIMES) - 1, 4).astype(int)
    noise = 0.05 * draw.normal(size=4), NOISE * draw.normal(size=len(TIMES))
    return {"few": (TIMES[chosen], exact[chosen] + noise[0]), "many": (TIMES, exact + noise[1])}


OWN = {"gain": 1.0, "own bias": 0.0, "bias": 0.0}


def test_noise_of_a_channel_with_parameters_of_its_own(known, motion):
    """As of linear regression, to each channel what it determines."""
    record = two_records(motion)
    found = lx.fit(lx.Experiment(known, record, two_encoders), OWN)
    told = found.predict()[0]
    for name, freedom in (("few", 4 - 2), ("many", len(TIMES) - 1)):
        left = np.sum((told[name] - record[name][1]) ** 2)
        np.testing.assert_allclose(found.noises[name], np.sqrt(left / freedom), rtol=1e-6)


def test_noise_beside_priors_and_what_is_not_determined(known, motion):
    """What a prior holds takes nothing from the noise, and neither does a number without influence."""
    record = two_records(motion)
    held = {"gain": lx.Normal(1.0, 1e-4), "own bias": lx.Normal(0.0, 1e-4), "bias": 0.0, "idle": 1.0}
    with pytest.warns(UserWarning, match="do not determine 'idle'"):
        found = lx.fit(lx.Experiment(known, record, two_encoders), held)
    left = np.sum((found.predict()[0]["few"] - record["few"][1]) ** 2)
    np.testing.assert_allclose(found.noises["few"], np.sqrt(left / 4), rtol=1e-4)


def test_steps_bound_those_of_all_noise(known, motion):
    experiment = lx.Experiment(known, two_records(motion), two_encoders)
    found = lx.fit(experiment, OWN, steps=2)
    assert (found.steps, found.ended) == (2, "out of steps")


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["squares", "huber", "cauchy"])
def test_intervals_cover_the_truth(known, loss):
    """With 5 % outliers, where the loss is made for them; and those of squares are wider then."""
    held, widths, delays = [], [], []
    for seed in range(40):
        record = {"encoder": (TIMES, told(known, seed, 0.0 if loss == "squares" else 0.05))}
        found = lx.fit(lx.Experiment(known, record, SENSORS[loss]), START)
        lower, upper = found.interval(0.95)
        held += [lower[name] < value < upper[name] for name, value in TRUTH.items()]
        widths.append(upper["delay"] - lower["delay"])
        delays.append(abs(found.params["delay"] - TRUTH["delay"]))
    assert 0.90 <= np.mean(held) <= 0.99
    assert np.max(delays) < 0.1 * 0.02
    if loss != "squares":
        plain = lx.fit(lx.Experiment(known, record, SENSORS["squares"]), START).interval()
        assert plain[1]["delay"] - plain[0]["delay"] > 2.0 * np.median(widths)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_losses(loss):
    """Squares near zero; known forms; derivatives as their formulas say, also at zero."""
    u = np.concatenate([np.linspace(-9.0, 9.0, 37), [1e-3, 0.02, 0.03]])
    cost = lambda u: 0.5 * as_square(loss, u) ** 2
    slope = jax.grad(cost)
    c = {"huber": 1.345, "cauchy": 2.385}[loss]
    known = {
        "huber": np.where(np.abs(u) < c, 0.5 * u**2, c * np.abs(u) - 0.5 * c**2),
        "cauchy": 0.5 * c**2 * np.log1p((u / c) ** 2),
    }[loss]
    np.testing.assert_allclose(jax.jit(cost)(u), known, rtol=1e-8)
    found = influence(loss, u)
    first, second = jax.jit(lambda u: (jax.vmap(slope)(u), jax.vmap(jax.grad(slope))(u)))(u)
    np.testing.assert_allclose(found.first, first, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.second, second, rtol=1e-5, atol=1e-9)
    normal = np.random.default_rng(0).normal(size=400_000)
    first, second = influence(loss, normal)[1:]
    np.testing.assert_allclose(np.mean(second) ** 2 / np.mean(first**2), 0.95, atol=5e-3)


def test_experiments_of_a_kind_are_one_batch(known, motion):
    """With what they share, and a bias of their own."""

    def sensors(params, own):
        return {"encoder": lx.Encoder("hinge", gain=params["gain"], bias=params["bias"][own], noise=NOISE)}

    values = [1.1 * np.asarray(motion.at(TIMES).joint("hinge")) + bias for bias in (0.3, -0.2)]
    alike = [lx.Experiment(known, {"encoder": (TIMES, entry)}, sensors, (i,)) for i, entry in enumerate(values)]
    other = lx.Experiment(known, {"encoder": (TIMES[5:], values[0][5:])}, sensors, (0,))
    together = Experiments.of([alike[0], other, alike[1]])
    assert together.places == [(0, 2), (1,)]
    params = {"gain": jnp.array(1.0), "bias": jnp.array([0.1, 0.2])}
    for rows, experiment in zip(together(params, {}), (alike[0], other, alike[1]), strict=True):
        np.testing.assert_allclose(rows["encoder"], experiment.residual(params, {})["encoder"], rtol=1e-12)
    found = lx.fit([alike[0], other, alike[1]], {"gain": 1.0, "bias": np.zeros(2)})
    np.testing.assert_allclose(found.params["gain"], 1.1, rtol=1e-6)
    np.testing.assert_allclose(found.params["bias"], [0.3, -0.2], rtol=1e-6)
    held_out = found.predict(lx.Experiment(known, {"encoder": (TIMES, values[1])}, sensors, (1,)))
    np.testing.assert_allclose(held_out[0]["encoder"], values[1], rtol=1e-6)


@pytest.mark.parametrize("loss", ["squares", pytest.param("huber", marks=pytest.mark.slow)])
def test_profiles_of_experiments_are_those_of_their_covariance(known, loss):
    """Of sensors that are linear; of a robust loss near the fit, where its curvature tells less than its scatter."""
    values = told(known, 0, 0.0 if loss == "squares" else 0.1)
    values[3] = np.nan
    sensors = lambda params: {"encoder": lx.Encoder("hinge", gain=params["gain"], bias=params["bias"], loss=loss)}
    experiment = lx.Experiment(known, {"encoder": (TIMES, values)}, sensors)
    start = {"gain": 1.0, "bias": 0.0} if loss == "squares" else {"gain": lx.Normal(1.05, 1e-9), "bias": 0.0}
    found = lx.fit(experiment, start, tolerance=1e-9)
    best, error = found.params["bias"], found.standard_errors["bias"]
    expected = np.array([-1.5, -0.5, 0.5, 1.5]) * (1.0 if loss == "squares" else 0.02)
    with pytest.warns(UserWarning, match="does not rise"):
        profile = lx.profile(experiment, found, "bias", values=best + expected * error)
    np.testing.assert_allclose(np.ptp(profile.roots), np.ptp(expected), rtol=1e-3)
    np.testing.assert_allclose(profile.roots, expected, atol=1e-3)
    assert np.all(profile.converged)
    with pytest.raises(ValueError, match="give them to the experiments"):
        lx.profile(experiment, found, "bias", (1.0,))
    with pytest.raises(ValueError, match="found the fit of a function; give that one"):
        lx.profile(experiment, lx.fit(lambda p: p["bias"] - TIMES, {"bias": 1.0}), "bias")


def test_numbers_tied_to_each_other(known, motion):
    """One number in two places: no more than a function of the parameters."""
    values = 1.1 * np.asarray(motion.at(TIMES).joint("hinge")) + 0.05
    tied = lambda params: {"encoder": lx.Encoder("hinge", gain=1.0 + 2.0 * params["size"], bias=params["size"])}
    found = lx.fit(lx.Experiment(known, {"encoder": (TIMES, values)}, tied), {"size": 0.01})
    np.testing.assert_allclose(found.params["size"], 0.05, rtol=1e-6)


def test_priors_are_measurements():
    """As one more row of a residual; where the data say nothing, they are all that is known."""
    data = 2.0 + np.random.default_rng(0).normal(size=9)
    known = lambda params: params["x"] - data
    found = lx.fit(known, {"x": lx.Normal(1.0, 0.5), "idle": lx.Normal([1.0, 2.0], [0.1, 0.2])})
    weight = 9 + 1 / 0.5**2
    np.testing.assert_allclose(found.params["x"], (np.sum(data) + 1.0 / 0.5**2) / weight, rtol=1e-7)
    np.testing.assert_allclose(found.params["idle"], [1.0, 2.0], rtol=1e-7)
    np.testing.assert_allclose(found.standard_errors["idle"], [0.1, 0.2], rtol=1e-6)
    assert found.undetermined == []
    assert len(found.residual) == 9
    np.testing.assert_allclose(found.noise**2, np.sum(found.residual**2) / (9 - 9 / weight), rtol=1e-6)
    loss = lx.fit(lambda params: 0.5 * jnp.sum(known(params) ** 2), {"x": lx.Normal(1.0, 0.5)})
    np.testing.assert_allclose(loss.params["x"], found.params["x"], rtol=1e-4)
    factor = lx.fit(lambda params: jnp.log(params["x"] / 4.0)[None], {"x": lx.LogNormal(1.0, np.e, value=2.0)})
    np.testing.assert_allclose(factor.params["x"], 2.0, rtol=1e-6)  # half way, in the logarithm
    regularised = lx.fit(
        lambda p: p["a"] + p["b"] - jnp.array([2.0]), {"a": lx.Normal(0.0, 1e3), "b": lx.Normal(0.0, 1e3)}
    )
    np.testing.assert_allclose(regularised.params["a"], regularised.params["b"], rtol=1e-6)


def test_several_starts_are_one_batch():
    """Of a residual with many minima, the best is found; a start where the function is not finite harms no other."""
    ts = np.linspace(0.0, 4.0, 80)
    wave = lambda p: p["size"] * jnp.sin(p["rate"] * ts)
    data = 2.0 * np.sin(5.0 * ts) + 0.01 * np.random.default_rng(0).normal(size=80)
    residual = lambda p, data: wave(p) - data
    start = {"size": 1.0, "rate": lx.Positive(1.0)}
    starts = {"size": np.ones(8), "rate": np.array([0.5, 1.5, 3.0, 4.6, 6.5, 8.0, -1.0, 12.0])}
    found = lx.fit(residual, start, (data,), starts=starts)
    np.testing.assert_allclose([found.params["size"], found.params["rate"]], [2.0, 5.0], rtol=1e-2)
    assert found.ended == "converged"
    assert found.starts.params["rate"].shape == (8,)
    assert found.starts.ended[6] == "diverged"
    assert np.isinf(found.starts.losses[6])
    assert np.argmin(found.starts.losses) in (3, 4)  # on both sides of it
    np.testing.assert_allclose(found.loss, np.min(found.starts.losses), rtol=1e-6)
    for index in (1, 3):
        alone = lx.fit(residual, {name: float(values[index]) for name, values in starts.items()}, (data,))
        np.testing.assert_allclose(alone.loss, found.starts.losses[index], rtol=1e-4)
    with pytest.raises(ValueError, match="finite at none of 2 starts"):
        lx.fit(residual, start, (data,), starts={"size": np.ones(2), "rate": -np.ones(2)})
    for wrong in ({"size": np.ones(2)}, {"size": np.ones(2), "rate": np.ones(3)}, {"size": 1.0, "rate": 1.0}):
        with pytest.raises(ValueError, match="give what params are, plain numbers"):
            lx.fit(residual, start, (data,), starts=wrong)


def test_starts_alone_need_to_be_predicted(known):
    """`params` and one start ask for times before the run; noise is that of the best of the others."""
    experiment = lx.Experiment(known, {"encoder": (TIMES, told(known, 0))}, SENSORS["squares"])
    starts = {"gain": np.ones(3), "bias": np.array([0.0, 0.1, 5.0]), "delay": np.array([0.5, 0.0, 0.0])}
    found = lx.fit(experiment, START | {"delay": 0.5}, starts=starts)
    assert found.starts.ended[0] == "diverged"
    again = lx.fit(experiment, START)
    for name in START:
        np.testing.assert_allclose(found.params[name], again.params[name], rtol=1e-5)
    with pytest.raises(ValueError, match=r"'encoder' cannot be predicted where the fit starts: time -0\.4 s"):
        lx.fit(experiment, START, starts={name: values[:1] for name, values in starts.items()})


def bad_fits(known):
    """(experiments, params, options, what is told)"""
    channel = (TIMES, np.zeros(len(TIMES)))
    experiment = lambda sensors, model=known, channel=channel: lx.Experiment(model, {"encoder": channel}, sensors)
    early = lambda params: {"encoder": lx.Encoder("hinge", delay=params["gain"])}
    wide = {"encoder": lx.Tracker("arm")}
    right = {"encoder": lx.Encoder("hinge")}
    other = {"encoder": lx.Encoder("hinge", noise=1.0)}
    three = experiment(wide, channel=(TIMES, np.zeros((len(TIMES), 3))))
    unlike = "'encoder' tells 3 numbers in experiment 1, and one number in experiment 0; give the channels different"
    return {
        "before the start": (experiment(early), {}, "'encoder' cannot be predicted where .*: time -0.9 s is out"),
        "no solution": (experiment(right, lambda params: 1.0), {}, "what a model returned is 1.0; let it return"),
        "shapes": (experiment(wide), {}, r"'encoder' has values of shape \(90,\), and Tracker tells \(90, 3\)"),
        "args": (experiment(right), {"args": (1.0,)}, "give them to the experiments"),
        "checkpoint": (experiment(right), {"checkpoint": "fit.npz"}, "give all sensors a noise"),
        "no experiments": ([], {}, "there are no experiments in the list"),
        "something else": ([experiment(right), 1.0], {}, "an entry of the experiments is 1.0"),
        "components": ([experiment(right), three], {}, unlike),
        "contradiction": ([experiment(right), experiment(other)], {}, "sensors of channel 'encoder' differ in their"),
    }


def test_bad_fits_are_named(known):
    for experiments, options, told in bad_fits(known).values():
        with pytest.raises(ValueError, match=told):
            lx.fit(experiments, {"gain": 1.0}, **options)


def test_bad_experiments_are_named(known):
    channel = (TIMES, np.zeros(len(TIMES)))
    with pytest.raises(KeyError, match=r"unknown channel 'encodr' .did you mean 'encoder'"):
        lx.Experiment(known, {"encoder": channel}, {"encodr": lx.Encoder("hinge")})
    for model, sensors, said in (
        (known, {}, "has no sensors"),
        (known, {"encoder": 1.0}, "sensor of channel 'encoder' is 1.0"),
        (known, 1.0, "sensors"),
        (1.0, {"encoder": lx.Encoder("hinge")}, r"model is 1\.0; give a function"),
    ):
        with pytest.raises(ValueError, match=said):
            lx.Experiment(model, {"encoder": channel}, sensors)


@pytest.mark.slow
def test_swings_with_initial_angles_of_their_own():
    """One program finds a shared delay and the angles at which two records began."""

    def model(params, own):
        return swing(params["starts"][own])

    def sensors(params, own):
        return {"encoder": lx.Encoder("hinge", delay=params["delay"], loss="huber")}

    truth = {"delay": jnp.array(0.02), "starts": jnp.array([-0.9, 0.5])}
    blank = {"encoder": (TIMES, np.zeros(len(TIMES)))}
    records = []
    for own in range(2):
        values = np.array(lx.Experiment(model, blank, sensors, (own,)).predict(truth)["encoder"])
        values += 1e-3 * np.random.default_rng(own).normal(size=values.shape)
        values[4] = 2.0
        records.append({"encoder": (TIMES, values)})
    experiments = [lx.Experiment(model, record, sensors, (own,)) for own, record in enumerate(records)]
    found = lx.fit(experiments, {"delay": 0.0, "starts": np.array([-0.7, 0.3])})
    assert abs(found.params["delay"] - 0.02) < 4.0 * found.standard_errors["delay"] < 2e-3
    np.testing.assert_allclose(found.params["starts"], truth["starts"], atol=1e-3)
    np.testing.assert_allclose(found.noises["encoder"], 1e-3, rtol=0.2)


def test_noise_is_no_parameter():
    sensors = lambda params: {"angle": lx.Encoder("hinge", noise=params["noise"])}
    model = lambda params: pytest.fail("the model is not needed to say so")
    experiment = lx.Experiment(model, {"angle": ([0.0, 0.1], [0.0, 0.1])}, sensors)
    with pytest.raises(ValueError, match="noise of channel 'angle' is a parameter"):
        lx.fit(experiment, {"noise": lx.Positive(0.1)})
