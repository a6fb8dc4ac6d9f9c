"""Pictures of right and wrong predictions: each panorama with its question and the numbers."""

import math
from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int8
from matplotlib.figure import Figure

from potlp_jax.learning.dataset import Samples, decode
from potlp_jax.learning.predictions import Predictions
from potlp_jax.view.style import CHOSEN, INK, QUIET, RIGHT, WRONG, new_figure
from potlp_jax.world.camera import roll_to

_KINDS = {
    "true positives": "right: success predicted, and the attempt succeeds",
    "true negatives": "right: failure predicted, and the attempt fails",
    "false positives": "wrong: success predicted, but the attempt fails",
    "false negatives": "wrong: failure predicted, but the attempt succeeds",
}
_COLUMNS = 2

_QUESTION_KEY = "stay: what must hold on the way; go: what is looked for beyond the subgoal, between the arrows"


def draw_predictions(
    samples: Samples, predictions: Predictions, chosen: Mapping[str, np.ndarray], title: str
) -> Figure:
    """Panoramas of the samples that ``most_confident`` chose, each rolled so that its subgoal is in the centre.

    Args:
        samples: with their images.
        predictions: of the same samples, in the same order.
        chosen: by kind ("true positives", ...), the indices of the samples to show, the most confident first.
        title: stands above.

    Returns:
        One block a kind, with the question and the figures below each panorama.
    """
    # Inches. Panoramas of the default camera (512 by 128) keep their proportions.
    width, picture, words, heading = 11.5, 5.5 / 4, 0.62, 0.42
    rows = {name: max(1, math.ceil(len(members) / _COLUMNS)) for name, members in chosen.items()}
    height = 0.68 + sum(heading + count * (picture + words) for count in rows.values())
    figure = new_figure(width, height)
    figure.text(0.5, 1 - 0.1 / height, title, ha="center", va="top", size=9, color=INK)
    figure.text(0.5, 1 - 0.34 / height, _QUESTION_KEY, ha="center", va="top", size=8, color=QUIET)
    top = height - 0.68
    for name, members in chosen.items():
        # True positives and true negatives: what was said came true.
        colour = RIGHT if name.startswith("true") else WRONG
        label = f"{_KINDS[name]} (most confident first)" if len(members) else f"{_KINDS[name]}: none"
        figure.text(0.2 / width, (top - 0.2) / height, label, va="center", size=11, weight="bold", color=colour)
        top -= heading
        for number, index in enumerate(members.tolist()):
            row, column = divmod(number, _COLUMNS)
            left, bottom = 0.2 + 5.6 * column, top - row * (picture + words) - picture
            box = (left / width, bottom / height, 5.5 / width, picture / height)
            _draw_prediction(figure, box, samples, predictions, index)
            text = describe_prediction(samples, predictions, index)
            figure.text(box[0], box[1] - 0.04 / height, text, va="top", size=7.5, color=INK, linespacing=1.15)
        top -= rows[name] * (picture + words)
    return figure


def describe_prediction(samples: Samples, predictions: Predictions, index: int) -> str:
    """Three lines: what must hold on the way, what is looked for, and the numbers, with the true ones that count.

    Args:
        samples: the questions and true answers.
        predictions: of the same samples, in the same order.
        index: which sample.

    Returns:
        The lines, joined. A true cost is given only where it was paid: R_S after success, R_F after failure.
    """
    stay, go = class_in_words(samples.phi_stay[index], samples.phi_go[index], samples.metadata.propositions)
    true = float(samples.success[index])
    numbers = [f"P_S {predictions.success[index]:.3f} (true {true:g})"]
    costs = (
        ("R_S", predictions.success_cost[index], samples.success_cost[index], true > 0),
        ("R_F", predictions.failure_cost[index], samples.failure_cost[index], true < 1),
    )
    # Costs are shown without digits: their errors are tens.
    numbers += [f"{name} {said:.0f}" + (f" (true {cost:.0f})" if counts else "") for name, said, cost, counts in costs]
    numbers.append(f"distance {samples.distance[index]:.0f} {samples.metadata.unit}")
    return "\n".join((stay, go, "    ".join(numbers)))


def class_in_words(
    phi_stay: Int8[np.ndarray, "P"], phi_go: Int8[np.ndarray, "P"], propositions: tuple[str, ...]
) -> tuple[str, str]:
    """What must hold on the way, and what at its end.

    Args:
        phi_stay, phi_go: vectors of the class, entries -1, 0, 1.
        propositions: their names, in the vectors' order.

    Returns:
        Two texts such as ``stay: not fire`` and ``go: alarm, not exit``.
    """

    def words(phi: np.ndarray) -> str:
        literals = list(zip(phi.tolist(), propositions, strict=True))
        wanted, unwanted = (
            [p for value, p in literals if value == 1],
            [f"not {p}" for value, p in literals if value == -1],
        )
        return ", ".join(wanted + unwanted) or "anything"

    return f"stay: {words(phi_stay)}", f"go: {words(phi_go)}"


def _draw_prediction(
    figure: Figure,
    box: tuple[float, float, float, float],
    samples: Samples,
    predictions: Predictions,
    index: int,
) -> None:
    axes = figure.add_axes(box)
    image = jnp.asarray(decode(samples.images[int(samples.view_of[index])]))
    # The network sees panoramas rolled in the same manner (docs/estimator.md).
    rolled = np.asarray(roll_to(image, jnp.float32(samples.bearing[index])))
    axes.imshow(rolled, aspect="auto", interpolation="nearest")
    rows, columns = rolled.shape[:2]
    centre = columns / 2 - 0.5
    style = {"color": CHOSEN, "markersize": 7, "markeredgecolor": "white", "markeredgewidth": 0.8, "clip_on": False}
    axes.plot([centre, centre], [0, rows - 1], color=CHOSEN, linewidth=0.6, alpha=0.55)
    axes.plot(centre, rows * 0.035, marker="v", **style)
    axes.plot(centre, rows * 0.955, marker="^", **style)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xticks=[], yticks=[])
