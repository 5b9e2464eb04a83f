"""Report a fit as one HTML file: what was found, how sure it is, how well it predicts."""

import io
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from linkax.files import writable_folder, written_whole
from linkax.plot.figure import Figure
from linkax.scenery.colours import BLUE, FAINT, INK, VERMILION, body_colour
from linkax.studies.fits.fit_result import EXACT, Fit, doubts, is_exact, remark_on
from linkax.studies.laboratory.experiments import Experiment
from linkax.studies.laboratory.losses import Loss, influence
from linkax.studies.laboratory.whiteness import Whiteness
from linkax.tables import count, numbers

MOST_POINTS = 2000  # that a picture draws one by one; of more it is made of pixels
MOST_NAMES = 24  # of parameters, whose correlations are written out
STRONG = 0.95  # correlation that is told
DOUBT = 0.05  # probability below which a residual is not white
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #333; max-width: 1060px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.6em; margin-bottom: 0 } h2 { font-size: 1.25em; margin-top: 2em; border-bottom: 1px solid #ddd }
h3 { font-size: 1em; margin: 1.4em 0 .3em } p { margin: .4em 0 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: .6em 0 }
td, th { padding: .15em .9em .15em 0; text-align: right; border-bottom: 1px solid #eee; white-space: nowrap }
td:first-child, th:first-child { text-align: left } th { font-weight: 600; color: #666 }
td.word { text-align: left; color: #b34700 } svg { max-width: 100%; height: auto }
.scroll { overflow-x: auto } .doubt { color: #b34700 } footer { color: #999; font-size: .85em; margin-top: 3em }
"""


class _Component(NamedTuple):
    """What is shown of one number of a channel; NaN where a sample is missing.

    - `residual`: in units of the noise. `shown`: the same as the loss lets it count.
    """

    name: str
    ts: Float[np.ndarray, " n"]
    measured: Float[np.ndarray, " n"]
    predicted: Float[np.ndarray, " n"]
    noise: float
    residual: Float[np.ndarray, " n"]
    shown: Float[np.ndarray, " n"]


def report(fit: Fit, path: Path, held_out: Sequence[Experiment]) -> Path:
    """Write the page, see `linkax.Fit.report`.

    **Raises:** as `linkax.Fit.report`.
    """
    writable_folder(path.parent, f"give another path than {str(path)!r}")
    title = f"Fit: {fit.ended} after {count(fit.steps, 'step')}"
    parts = [f"<h1>{escape(title)}</h1>", _summary(fit), "<h2>Parameters</h2>", _parameters(fit), _determined(fit)]
    parts += [f"<p class=doubt>{escape(doubt)}.</p>" for doubt in doubts(fit)]
    if fit.covariance is not None:
        parts += ["<h2>Covariance and correlation</h2>", _correlation(fit)]
    parts += ["<h2>Loss</h2>", _picture(_loss(fit))]
    for head, experiments in (("Fitted records", fit.experiments), ("Records held out", held_out)):
        if experiments:
            parts += [f"<h2>{head}</h2>", *_records(fit, experiments)]
    if not fit.experiments and fit.residual is not None:
        parts += ["<h2>Residual</h2>", *_channel([_of_residual(np.asarray(fit.residual))])]
    text = f"<!DOCTYPE html><html lang=en><head><meta charset=utf-8><title>{escape(title)}</title>"
    text += f"<style>{STYLE}</style></head><body>{''.join(parts)}<footer>linkax</footer></body></html>"
    with written_whole(path) as part:
        part.write_text(text, encoding="utf-8")
    return path


def _summary(fit) -> str:
    facts = [f"loss {numbers(fit.loss)}"]
    if fit.residual is not None:
        facts.append(f"{len(fit.residual)} measurements, {count(len(fit.names), 'number')} fitted")
    if fit.noise is not None:
        facts.append(
            f"residual of standard deviation {numbers(fit.noise)}, in units of the noise"
            if fit.experiments
            else f"noise {numbers(fit.noise)}"
        )
    return f"<p>{escape('; '.join(facts + [EXACT] * is_exact(fit)))}</p>"


def _flat(tree) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(leaf)) for leaf in jax.tree.leaves(tree)])


def _table(head, rows) -> str:
    cell = lambda entry: (
        f"<td class=word>{escape(entry[1:])}</td>" if entry.startswith("!") else f"<td>{escape(entry)}</td>"
    )
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return (
        f"<div class=scroll><table><tr>{''.join(f'<th>{escape(name)}</th>' for name in head)}</tr>{body}</table></div>"
    )


def _parameters(fit) -> str:
    values = _flat(fit.params)
    if fit.covariance is None:
        return _table(("parameter", "value"), zip(fit.names, map(numbers, values), strict=True))
    errors = np.sqrt(np.diagonal(fit.covariance))
    lower, upper = map(_flat, fit.interval(0.95))
    rows = []
    for name, value, error, low, high in zip(fit.names, values, errors, lower, upper, strict=True):
        if name in fit.undetermined:
            rows.append((name, numbers(value), "", "", "", "", "!" + remark_on(fit, name)))
            continue
        if name in fit.on_bound:
            rows.append((name, numbers(value), "", "", numbers(low), numbers(high), "!" + remark_on(fit, name)))
            continue
        share = f"{100.0 * error / abs(value):.2g} %" if value else ""
        rows.append((name, numbers(value), numbers(error), share, numbers(low), numbers(high), ""))
    return _table(("parameter", "value", "standard error", "of value", "95 % from", "to", ""), rows)


def _determined(fit) -> str:
    if not fit.undetermined:
        told = (
            "The data determine all parameters" + (", but for those on a bound." if fit.on_bound else ".")
            if fit.covariance is not None
            else "No covariance: see how the fit ended."
        )
        return f"<p>{told}</p>"
    names = ", ".join(fit.undetermined)
    return (
        f"<p class=doubt>Not determined: {escape(names)}. A change of these, one or several together, leaves the "
        "residual as it is; fix some, give them a prior, or measure what they act on.</p>"
    )


def _correlation(fit) -> str:
    unknown = {*fit.undetermined, *fit.on_bound}
    known = [index for index, name in enumerate(fit.names) if name not in unknown]
    if len(known) < 2:
        return "<p>Fewer than two parameters are determined.</p>"
    names, covariance = [fit.names[index] for index in known], np.asarray(fit.covariance)[np.ix_(known, known)]
    errors = np.sqrt(np.diagonal(covariance))
    safe = np.where(errors > 0.0, errors, 1.0)
    correlation = covariance / np.outer(safe, safe)
    pairs = [(i, j) for i in range(len(names)) for j in range(i) if abs(correlation[i, j]) > STRONG]
    pairs.sort(key=lambda pair: -abs(correlation[pair]))
    told = "; ".join(f"{names[j]} and {names[i]} {correlation[i, j]:+.4f}" for i, j in pairs[:10])
    strong = f"<p class=doubt>Hard to tell apart: {escape(told)}.</p>" if pairs else ""
    rows = [(name, *(f"{entry:.3g}" for entry in row)) for name, row in zip(names, covariance, strict=True)]
    table = _table(("covariance", *names), rows) if len(names) <= MOST_NAMES else ""
    return _picture(_heat(names, correlation)) + strong + table


def _heat(names, correlation) -> Figure:
    size = len(names)
    side = min(max(0.55 * size, 2.2), 9.0)
    figure = Figure(figsize=(side + 2.6, side + 1.2), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(correlation, vmin=-1.0, vmax=1.0, cmap="RdBu_r")
    axes.set_xticks(range(size), names, rotation=45, ha="right")
    axes.set_yticks(range(size), names)
    axes.spines[:].set_visible(False)
    if size <= MOST_NAMES:
        for i, j in np.ndindex(size, size):
            colour = "white" if abs(correlation[i, j]) > 0.6 else INK
            axes.text(j, i, f"{correlation[i, j]:.2f}", ha="center", va="center", fontsize=8, color=colour)
    figure.colorbar(image, label="correlation", shrink=0.8)
    return figure


def _loss(fit) -> Figure:
    figure = Figure(figsize=(6.0, 2.2), layout="constrained")
    axes = figure.subplots()
    losses = np.asarray(fit.history["loss"])
    axes.plot(np.where(np.isfinite(losses), losses, np.nan), ".-", color=BLUE)
    if np.all(losses[np.isfinite(losses)] > 0.0):
        axes.set_yscale("log")
    axes.set(xlabel="step", ylabel="loss, by the noise found so far" if fit.noises else "loss")
    _plain(axes)
    return figure


def _records(fit, experiments) -> list[str]:
    parts = []
    for place, (experiment, predicted) in enumerate(zip(experiments, fit.predict(experiments), strict=True)):
        sensors = experiment.sensors_at(fit.params)
        for name, sensor in sensors.items():
            channel = experiment.record[name]
            noise = _noise(fit, name, channel) if sensor.noise is None else np.asarray(sensor.noise)
            head = f"experiment {place}: {name}" if len(experiments) > 1 else name
            told = f" ({type(sensor).__name__}, {sensor.loss})"
            parts.append(f"<h3>{escape(head + told)}</h3>")
            parts += _channel(_components(channel, predicted[name], noise, sensor.loss))
    return parts


def _noise(fit, name, channel) -> np.ndarray:
    """Of a channel whose sensor gives none."""
    found, shape = (fit.noises or {}).get(name), channel.values.shape[1:]
    if found is None:
        raise ValueError(f"channel {name!r} is held out, and this fit found no noise for it; give one to its sensor")
    if np.shape(found) != shape:
        raise ValueError(
            f"channel {name!r} is held out with values of shape {shape}, and its noise was found with shape "
            f"{np.shape(found)}; give the channels different names"
        )
    return found


def _components(channel, predicted, noise, loss: Loss) -> list[_Component]:
    columns = lambda values: np.reshape(values, (len(channel.ts), -1)).T
    noises = np.broadcast_to(noise, channel.values.shape[1:]).ravel()
    found = []
    for index, (measured, told) in enumerate(zip(columns(channel.values), columns(predicted), strict=True)):
        residual = (told - measured) / noises[index]
        there = np.isfinite(residual)
        shown = np.where(there, influence(loss, np.where(there, residual, 0.0)).first, np.nan)
        name = "" if channel.values.ndim == 1 else str(index)
        found.append(_Component(name, np.asarray(channel.ts), measured, told, float(noises[index]), residual, shown))
    return found


def _of_residual(residual) -> _Component:
    places = np.arange(len(residual), dtype=float)
    scale = float(np.sqrt(np.mean(residual**2))) or 1.0
    return _Component("", places, residual, 0.0 * residual, scale, residual / scale, residual / scale)


def _channel(components: list[_Component]) -> list[str]:
    """A picture of a channel, and a table of its numbers."""
    head = ("component", "samples", "missing", "noise", "residual / noise", "beyond 3", "whiteness")
    rows, white = [], [Whiteness.of(component.shown) for component in components]
    for component, of_component in zip(components, white, strict=True):
        there = component.residual[np.isfinite(component.residual)]
        told = "" if of_component is None else f"p = {of_component.probability:.2g}"
        doubt = "!" if of_component is not None and of_component.probability < DOUBT else ""
        size, beyond = np.sqrt(np.mean(there**2)) if len(there) else np.nan, np.sum(np.abs(there) > 3.0)
        missing = str(int(np.sum(np.isnan(component.measured))) or "")
        name = component.name or "–"
        rows.append(
            (name, str(len(there)), missing, numbers(component.noise), f"{size:.3g}", str(beyond or ""), doubt + told)
        )
    return [_picture(_fits(components, white)), _table(head, rows)]


def _fits(components, white) -> Figure:
    figure = Figure(figsize=(10.5, 3.0), layout="constrained")
    over, left, apart = figure.subplots(1, 3, width_ratios=(2.0, 1.5, 1.2))
    several = len(components) > 1
    for index, (component, of_component) in enumerate(zip(components, white, strict=True)):
        colour = body_colour(index) if several else BLUE
        many = len(component.ts) > MOST_POINTS
        over.plot(component.ts, component.measured, ".", ms=2.5, color=colour, alpha=0.5, rasterized=many)
        label = component.name if several else "predicted"
        over.plot(
            component.ts,
            component.predicted,
            "-",
            lw=1.2,
            color=colour if several else VERMILION,
            label=label,
            rasterized=many,
        )
        inside = np.abs(component.residual) <= 5.0
        left.plot(
            component.ts, np.where(inside, component.residual, np.nan), ".", ms=2.5, color=colour, rasterized=many
        )
        far = np.abs(component.residual) > 5.0
        left.plot(component.ts[far], 5.0 * np.sign(component.residual[far]), "x", ms=4, color=colour)
        if of_component is not None:
            lags = np.arange(1, len(of_component.correlations) + 1) + 0.25 * index
            apart.vlines(lags, 0.0, of_component.correlations, color=colour, lw=1.5)
            bounds = of_component.bounds
            apart.fill_between(lags, -bounds, bounds, color=FAINT, alpha=0.25 / len(components), lw=0)
    over.set(xlabel="time [s]", title="measured (dots) and predicted")
    over.legend(fontsize=7, frameon=False, ncols=2)
    for level in (-2.0, 2.0):
        left.axhline(level, color=FAINT, lw=0.8, ls="--")
    left.set(xlabel="time [s]", title="(predicted − measured) / noise, beyond ±5 as ×", ylim=(-5.4, 5.4))
    apart.axhline(0.0, color=INK, lw=0.6)
    apart.set(xlabel="samples apart", title="autocorrelation, 95 % band", ylim=(-1.0, 1.0))
    for axes in (over, left, apart):
        axes.title.set_fontsize(9)
        _plain(axes)
    return figure


def _plain(axes):
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)
    axes.xaxis.label.set_fontsize(8)
    axes.yaxis.label.set_fontsize(8)


def _picture(figure: Figure) -> str:
    """A figure as SVG within the page."""
    stream = io.StringIO()
    figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]
