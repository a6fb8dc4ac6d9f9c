"""An estimator's figures as tables, and as pictures: reliability and costs."""

import itertools
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.box import SIMPLE_HEAD
from rich.table import Table

from potlp_jax.learning.ablations import INTACT
from potlp_jax.learning.dataset import Samples
from potlp_jax.learning.metrics import CostErrors, Figures, Report
from potlp_jax.learning.predictions import Predictions
from potlp_jax.view.style import CHOSEN, FAINT, INK, SERIES_COLOURS, new_figure

VARIANTS: Mapping[str, str] = MappingProxyType({INTACT: "intact", "image": "image blacked out", "phi": "phi shuffled"})
"""What was evaluated, in words."""

_PARTS = {"proposition": "asks for {}", "avoided": "propositions avoided: {}", "distance": "distance {}"}


def probability_table(report: Report, title: str) -> Table:
    """The figures of P_S, of all samples and of every group."""
    names = ("number", "mean\nP_S", "Brier\nscore", "skill", "own\nskill", "log\nloss", "AUC", "calib.\nerror")

    def cells(figures: Figures) -> list[str]:
        values = (figures.skill, figures.own_skill, figures.log_loss, figures.auc, figures.calibration_error)
        first = [f"{figures.samples}", _number(figures.success_rate, 2), _number(figures.brier, 3)]
        return first + [_number(value, 3) for value in values]

    return _group_table(f"{title}: P_S", names, [cells(figures) for _, figures in _rows(report)], report)


def cost_table(report: Report, title: str) -> Table:
    """The errors of R_S where it succeeded and of R_F where it failed, of all samples and of every group."""
    names = [f"{cost}\n{name}" for cost in ("R_S", "R_F") for name in ("MAE", "RMSE", "bias", "calib.", "R²")]

    def cells(errors: CostErrors) -> list[str]:
        values = [_number(value, 1) for value in (errors.mae, errors.rmse, errors.bias, errors.calibration_error)]
        return [*values, _number(errors.r2, 2)]

    rows = [cells(figures.success_cost) + cells(figures.failure_cost) for _, figures in _rows(report)]
    return _group_table(f"{title}: costs", names, rows, report)


def cost_bin_table(report: Report, title: str) -> Table:
    """Predicted and true costs by bin of what was predicted, of all samples: R_S where it succeeded, R_F otherwise."""
    table = Table(title=f"{title}: calibration of costs", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("predicted", no_wrap=True)
    for name in ("number", "mean\npredicted", "mean\ntrue", "bias"):
        table.add_column(name, justify="right", no_wrap=True)
    for name, errors in (("R_S", report.overall.success_cost), ("R_F", report.overall.failure_cost)):
        for number, entry in enumerate(errors.bins, start=1):
            means = (entry.predicted, entry.true, entry.predicted - entry.true)
            table.add_row(
                f"{name} {_number(entry.low, 1)} to {_number(entry.high, 1)}",
                f"{entry.samples}",
                *(_number(value, 1) for value in means),
                end_section=number == len(errors.bins),
            )
    return table


def ablation_table(reports: Mapping[str, Report]) -> Table:
    """What is left of the skill, of all samples and of every group, when something is taken away.

    ``reports`` has ``intact``, and the ablations.
    """
    others = [name for name in reports if name != INTACT]
    names = ["intact\nskill"]
    for other in others:
        names += [VARIANTS[other].replace(" ", "\n", 1), "share\nlost"]
    skills = {name: [figures.skill for _, figures in _rows(report)] for name, report in reports.items()}
    rows = []
    for number, intact in enumerate(skills[INTACT]):
        cells = [_number(intact, 3)]
        for other in others:
            # A share of a skill that is not there means nothing.
            lost = (intact - skills[other][number]) / intact if intact > 0 else math.nan
            cells += [_number(skills[other][number], 3), "-" if math.isnan(lost) else f"{100 * lost:.0f}%"]
        rows.append(cells)
    return _group_table("ablations: skill over the constant prior", names, rows, reports[INTACT])


def _rows(report: Report) -> list[tuple[str, Figures]]:
    """All samples, then the parts of every group, with names for people."""
    parts = [
        (_PARTS[group].format(part), figures)
        for group, members in report.groups.items()
        for part, figures in members.items()
    ]
    return [("all", report.overall), *parts]


def _last_rows(report: Report) -> set[int]:
    """Positions in ``_rows`` after which another group begins."""
    # Row 0 holds all samples; each group begins after the members before it.
    return set(itertools.accumulate((len(members) for members in report.groups.values()), initial=0))


def _group_table(title: str, names: Sequence[str], rows: Sequence[Sequence[str]], report: Report) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, padding=0)
    table.add_column("samples", no_wrap=True)
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    ends = _last_rows(report)
    for number, ((name, _), cells) in enumerate(zip(_rows(report), rows, strict=True)):
        table.add_row(name, *cells, end_section=number in ends, style=None if number else "bold")
    return table


def _number(value: float, digits: int) -> str:
    # Adding zero turns a rounded -0.0 into 0.0.
    return "-" if math.isnan(value) else f"{round(value, digits) + 0.0:.{digits}f}"


def draw_reliability(reports: Mapping[str, Report], title: str) -> Figure:
    """Left, the share of successes over the predicted P_S, with the numbers of predictions; right, skill by group.

    ``reports`` has ``intact``, and the ablations that were made; those show up in the right panel.
    """
    figure = new_figure(11.5, 5.9)
    figure.text(0.5, 0.975, title, ha="center", va="top", size=9, color=INK)
    overall = reports[INTACT].overall
    _draw_bins(figure.add_axes((0.07, 0.32, 0.37, 0.58)), overall)
    _draw_counts(figure.add_axes((0.07, 0.09, 0.37, 0.17)), overall)
    _draw_skills(figure.add_axes((0.63, 0.09, 0.35, 0.81)), reports)
    return figure


def _draw_bins(axes: Axes, figures: Figures) -> None:
    # An empty bin has no share of successes; a point at 0 would look like an error.
    filled = [entry for entry in figures.bins if entry.samples]
    axes.plot([0, 1], [0, 1], color=FAINT, linewidth=1.0, label="calibrated")
    axes.axhline(figures.success_rate, color=FAINT, linewidth=1.0, linestyle=":", label="mean of all samples")
    said, seen = [entry.predicted for entry in filled], [entry.observed for entry in filled]
    # Of a proportion. Samples of one world are dependent: the true error is larger, as the legend says.
    errors = [2 * math.sqrt(max(y * (1 - y), 0.0) / entry.samples) for y, entry in zip(seen, filled, strict=True)]
    style = {"color": SERIES_COLOURS[0], "marker": "o", "markersize": 5, "linewidth": 1.5, "capsize": 2}
    axes.errorbar(said, seen, errors, **style, label="± 2 standard errors, as if independent")
    axes.set(xlim=(0, 1), ylim=(-0.02, 1.02))
    axes.set_ylabel("share of attempts that succeed", color=INK)
    axes.tick_params(labelbottom=False)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", fontsize=8.5, framealpha=0.9)
    # Above the panel: within it, a badly calibrated estimator's points may be anywhere, also below any text.
    axes.set_title(
        f"Brier score {figures.brier:.4f}, skill {_number(figures.skill, 3)}, AUC {_number(figures.auc, 3)}, "
        f"calibration error {figures.calibration_error:.3f}",
        size=8,
        color=INK,
    )


def _draw_counts(axes: Axes, figures: Figures) -> None:
    middle = [(entry.low + entry.high) / 2 for entry in figures.bins]
    # Bins are equally wide.
    width = 0.9 * (figures.bins[0].high - figures.bins[0].low)
    axes.bar(middle, [entry.samples for entry in figures.bins], width, color=SERIES_COLOURS[3])
    axes.set(xlim=(0, 1))
    axes.set_xlabel("predicted P_S", color=INK)
    axes.set_ylabel("samples", color=INK)
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))


def _draw_skills(axes: Axes, reports: Mapping[str, Report]) -> None:
    rows = _rows(reports[INTACT])
    # By name, so that a variant looks the same whichever others were evaluated.
    styles = {INTACT: ("o", SERIES_COLOURS[0]), "image": ("s", SERIES_COLOURS[1]), "phi": ("D", SERIES_COLOURS[2])}
    least = 0.0
    for name, report in reports.items():
        skills = [figures.skill for _, figures in _rows(report)]
        marker, colour = styles[name]
        axes.scatter(skills, range(len(rows)), s=34, marker=marker, color=colour, label=VARIANTS[name], zorder=3)
        least = min([least, *(skill for skill in skills if math.isfinite(skill))])
    # No line after the last group, where the panel ends.
    for last in sorted(_last_rows(reports[INTACT]))[:-1]:
        axes.axhline(last + 0.5, color="#DDDDDD", linewidth=0.8)
    axes.set_yticks(range(len(rows)), [f"{name} ({figures.samples})" for name, figures in rows], size=8.5)
    axes.axvline(0, color=INK, linewidth=0.8)
    # Downward, in the order of the tables.
    axes.set(ylim=(len(rows) - 0.4, -0.6), xlim=(1.05 * least - 0.04, 1.02))
    axes.set_xlabel("Brier skill over the constant prior", color=INK)
    axes.grid(axis="x", color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    if len(reports) > 1:
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8, frameon=False, borderpad=0)


def draw_costs(samples: Samples, predictions: Predictions, report: Report, title: str) -> Figure:
    """Predicted over true costs, calibration and bias by group: R_S of attempts that succeed, R_F of those that fail.

    Args:
        samples: the true costs.
        predictions: of the same samples, in the same order.
        report: of these predictions.
        title: stands above.

    Returns:
        Above, two panels of densities with the diagonal and the constant prediction. In the middle, mean true over mean
        predicted costs by bin. Below, the bias of every group.
    """
    # Inches: the bias has a line for each group.
    lines = 0.24 * len(_rows(report)) + 0.2
    height = 10.9 + lines
    figure = new_figure(11.5, height)
    figure.text(0.5, 1 - 0.14 / height, title, ha="center", va="top", size=9, color=INK)
    unit = samples.metadata.unit
    panels = (
        ("R_S", "success_cost", "of attempts that succeed", samples.success),
        ("R_F", "failure_cost", "of attempts that fail", 1 - samples.success),
    )
    for column, (name, field, which, share) in enumerate(panels):
        left = 0.06 + 0.49 * column
        true, said, errors = getattr(samples, field), getattr(predictions, field), getattr(report.overall, field)
        # A share of successes strictly between 0 and 1 puts the sample into both panels, with that weight.
        known = (share > 0) & np.isfinite(true)
        axes = figure.add_axes((left, (lines + 5.7) / height, 0.42, 4.4 / height))
        _draw_cost(axes, true[known], said[known], share[known], unit)
        axes.set_title(f"{name} {which} ({errors.samples} samples; darker: more)\n{_told(errors)}", size=9.5, color=INK)
        _draw_cost_bins(figure.add_axes((left, (lines + 1.2) / height, 0.42, 3.6 / height)), name, errors, unit)
        # The names of the groups take a third of the panel's width.
        biases = figure.add_axes((left + 0.14, 0.55 / height, 0.28, lines / height))
        _draw_biases(biases, name, field, report, unit)
    return figure


def _told(errors: CostErrors) -> str:
    return (
        f"MAE {_number(errors.mae, 1)}, RMSE {_number(errors.rmse, 1)}, bias {_number(errors.bias, 1)}, "
        f"R² {_number(errors.r2, 2)}"
    )


def _draw_cost_bins(axes: Axes, name: str, errors: CostErrors, unit: str) -> None:
    """Mean true over mean predicted costs; bins that lie on the diagonal are calibrated."""
    said, true = [entry.predicted for entry in errors.bins], [entry.true for entry in errors.bins]
    # Of a mean. Samples of one world are dependent: the true error is larger, as the legend says.
    spread = [2 * entry.spread / math.sqrt(entry.samples) for entry in errors.bins]
    limit = 1.08 * max([1.0, *said, *(mean + error for mean, error in zip(true, spread, strict=True))])
    axes.plot([0, limit], [0, limit], color=FAINT, linewidth=1.0, label="calibrated")
    if said:
        style = {"color": SERIES_COLOURS[0], "marker": "o", "markersize": 5, "linewidth": 1.5, "capsize": 2}
        axes.errorbar(said, true, spread, **style, label="± 2 standard errors, as if independent")
    axes.set(xlim=(0, limit), ylim=(0, limit))
    axes.set_xlabel(f"mean predicted {name} of a bin [{unit}]", color=INK)
    axes.set_ylabel(f"mean true {name} [{unit}]", color=INK)
    axes.grid(color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.legend(loc="upper left", fontsize=8.5, framealpha=0.9)
    axes.set_title(
        f"bins with equally many samples; calibration error {_number(errors.calibration_error, 1)} {unit}",
        size=8,
        color=INK,
    )


def _draw_biases(axes: Axes, name: str, field: str, report: Report, unit: str) -> None:
    """The bias of every group; below 0 the cost is predicted too low."""
    rows = [(part, getattr(figures, field)) for part, figures in _rows(report)]
    axes.barh(range(len(rows)), [errors.bias for _, errors in rows], 0.62, color=SERIES_COLOURS[3])
    axes.axvline(0, color=INK, linewidth=0.8)
    for last in sorted(_last_rows(report))[:-1]:
        axes.axhline(last + 0.5, color="#DDDDDD", linewidth=0.8)
    axes.set_yticks(range(len(rows)), [f"{part} ({errors.samples})" for part, errors in rows], size=8)
    axes.set(ylim=(len(rows) - 0.4, -0.6))
    axes.set_xlabel(f"bias of {name}: mean of predicted − true [{unit}]", color=INK)
    axes.grid(axis="x", color="#EEEEEE", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw_cost(axes: Axes, true: np.ndarray, said: np.ndarray, share: np.ndarray, unit: str) -> None:
    # At least 1: without samples the axes still need a length.
    limit = 1.03 * max([1.0, *true.tolist(), *said.tolist()])
    axes.plot([0, limit], [0, limit], color=FAINT, linewidth=1.0, zorder=3)
    if len(true):
        # Logarithmic, because most samples fall into few cells; from 0.3, so that a single sample is not white.
        axes.hexbin(true, said, gridsize=48, extent=(0, limit, 0, limit), bins="log", mincnt=1, cmap="Blues", vmin=0.3)
        # What an estimator that never looks would say at best.
        mean = float(np.average(true, weights=share))
        axes.axhline(mean, color=CHOSEN, linewidth=1.0, linestyle=":")
        note = {"textcoords": "offset points", "ha": "right", "va": "bottom", "size": 8, "color": CHOSEN}
        # The rim parts the words from the cells that they may lie on.
        rim = [patheffects.withStroke(linewidth=2.5, foreground="white")]
        axes.annotate("the constant mean", (limit, mean), (-4, 2), path_effects=rim, **note)
    axes.set(xlim=(0, limit), ylim=(0, limit))
    axes.set_xlabel(f"true cost [{unit}]", color=INK)
    axes.set_ylabel(f"predicted cost [{unit}]", color=INK)
