"""Reports of fits: whole, without network, and honest about what is not white and not determined."""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.studies.laboratory.whiteness import Whiteness

TIMES = np.linspace(0.0, 4.0, 120)


@pytest.fixture(scope="module")
def still():
    """A model whose sensors alone have parameters."""
    begin = lx.Solution.of_state(pendulum(gravity=0.0), lx.State(np.array([0.3]), np.array([0.5])))
    ts, q, v = jnp.array([0.0, 4.0]), jnp.array([[0.3], [2.3]]), jnp.array([[0.5], [0.5]])
    return dataclasses.replace(begin, ts=ts, q=q, v=v)


@pytest.fixture(scope="module")
def fits(still):
    draw = np.random.default_rng(0)
    angle = 0.3 + 0.5 * TIMES

    def sensors(params):
        whole = {"gain": params["gain"], "bias": params["bias"]}
        return {
            "encoder <1>": lx.Encoder("hinge", **whole, loss="cauchy"),
            "camera": lx.Tracker("arm", "tip", components=(0, 1), noise=0.01),
        }

    tip = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    wrong = tip + 0.02 * np.sin(TIMES)[:, None]  # what the model does not know

    def recorded(values):
        noisy = 1.1 * angle + 0.2 + 0.02 * draw.normal(size=120)
        noisy[[5, 50]] += 1.0
        noisy[7] = np.nan
        channels = {"encoder <1>": (TIMES, noisy), "camera": (TIMES, values + 0.01 * draw.normal(size=(120, 2)))}
        return lx.Experiment(lambda params: still, channels, sensors)

    with pytest.warns(UserWarning, match="do not determine 'idle'"):
        found = lx.fit(recorded(wrong), {"gain": 1.0, "bias": 0.0, "idle": 3.0})
    return found, recorded(tip)


def test_a_report_of_experiments(fits, tmp_path):
    found, held_out = fits
    path = found.report(tmp_path / "new folder" / "fit.html", held_out)
    text = path.read_text()
    assert [entry.name for entry in path.parent.iterdir()] == ["fit.html"]
    assert not re.search(r"(src|href)=\"(?!#|data:)|url\((?!#)|@import|<script", text)
    assert text.count("<svg") == 2 + 4  # correlation, loss, and four channels
    assert "encoder &lt;1&gt; (Encoder, cauchy)" in text
    assert "Not determined: idle." in text
    for name in ("gain", "bias"):
        assert f"<td>{name}</td>" in text
    channels = re.findall(r"<h3>.*?(?=<h[23]>|<footer>)", text, re.DOTALL)
    doubts = {place: len(re.findall("<td class=word>p = ", part)) for place, part in enumerate(channels)}
    camera = next(place for place, part in enumerate(channels) if "camera" in part)
    assert doubts[camera] == 2  # along both axes: the model does not know what moves it
    assert sum(doubts.values()) == 2


def test_a_report_of_a_function(tmp_path):
    data = 1.0 + 0.5 * TIMES + 0.1 * np.random.default_rng(0).normal(size=120)
    found = lx.fit(lambda p: p["at_zero"] + p["slope"] * TIMES - data, {"at_zero": 1.0, "slope": 1.0})
    text = found.report(tmp_path / "fit.html").read_text()
    assert text.count("<svg") == 3
    assert "The data determine all parameters." in text
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="give another path than"):
        found.report(tmp_path / "file" / "fit.html")
    with pytest.raises(ValueError, match="fit of a function, which has no sensors; call it"):
        found.predict()
    loss = lx.fit(lambda p: (p["x"] - 1.0) ** 2, {"x": 2.0}, steps=3)
    assert "no covariance" in loss.report(tmp_path / "loss.html").read_text().lower()


def test_whiteness_is_told_as_often_as_its_probability_says():
    """Five times in a hundred of white noise, with samples missing, and nearly always of what drifts."""
    draw = np.random.default_rng(0)
    white, correlated, within = [], [], []
    for _ in range(400):
        noise = draw.normal(size=200)
        noise[draw.uniform(size=200) < 0.1] = np.nan
        found = Whiteness.of(noise)
        white.append(found.probability < 0.05)
        within.append(np.mean(np.abs(found.correlations) < found.bounds))
        drifting = np.convolve(draw.normal(size=201), [1.0, 0.5], "valid")
        correlated.append(Whiteness.of(drifting).probability < 0.05)
    assert 0.02 < np.mean(white) < 0.09
    assert 0.93 < np.mean(within) < 0.97
    assert np.mean(correlated) > 0.95
    assert Whiteness.of(np.ones(50)) is None
    assert Whiteness.of(np.arange(5.0)) is None


def test_what_cannot_be_predicted_is_told_before_anything_is_written(fits, still, tmp_path):
    found, held_out = fits
    seen = lambda name, ts, values, sensor: lx.Experiment(lambda params: still, {name: (ts, values)}, {name: sensor})
    beyond = seen("wheel", TIMES + 1.0, np.zeros(120), lx.Encoder("hinge", noise=1.0))
    unknown = seen("wheel", TIMES, np.zeros(120), lx.Encoder("hinge"))
    wide = seen("encoder <1>", TIMES, np.zeros((120, 3)), lx.Tracker("arm"))
    outside = r"channel 'wheel' of experiment 1 cannot be predicted with the fitted parameters: time .* is outside"
    for given, told in (
        ([held_out, beyond], outside),
        (unknown, "channel 'wheel' is held out, and this fit found no noise for it; give one to its sensor"),
        (wide, r"'encoder <1>' is held out with values of shape \(3,\), and its noise was found with shape \(\)"),
    ):
        with pytest.raises(ValueError, match=told):
            found.report(tmp_path / "fit.html", given)
    with pytest.raises(ValueError, match=outside):
        found.predict([held_out, beyond])
    assert list(tmp_path.iterdir()) == []
