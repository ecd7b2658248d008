"""Small things in dreams: which of those that are there some decisions later a dream shows, and the reverse.

A dream goes on from a recorded state under the recorded actions. Two controls stand beside it. `code` is the decoder's
picture of the true picture's own latent, which an exact dream would show. `held` is the picture of the recorded state
as it is: a dream that agrees no better has predicted nothing.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.inspection.disturbed_rollouts import draw_rows
from dreamfleet.worker.addons.inspection.encoded_rollout import EncodedRollout
from dreamfleet.worker.addons.inspection.mdnrnn_sections import TEMPERATURES, follow_drive
from dreamfleet.worker.addons.inspection.page import FONT, Pictures, Section, new_figure, render_png
from dreamfleet.worker.dream.noise import EpisodeNoise
from dreamfleet.worker.training.spots import SIZES, find_spots, measure_mean
from dreamfleet.worker.worldmodel.inference import Decoder, DreamStep

AHEAD = (1, 2, 4, 8)  # decisions after the recorded state
STATES = 400  # recorded ones: drives are taken until they have so many
STARTS = 200  # of them, evenly spaced, are dreamt on from: neighbours have mostly the same spots
MOST_DRIVES = 8
FEWEST = 20  # spots of which a share is drawn
CODE, HELD = "code", "held"
NAME, TITLE = "dreamt-spots", "The small things that it dreams"
LOOKS: Mapping[str, Mapping[str, Any]] = {  # of a line, by its source
    CODE: {"label": "the true picture, encoded and decoded", "color": "0.7", "linewidth": 4},
    "dream_0.5": {"label": "dream, temperature 0.5", "color": "tab:blue", "marker": "o", "markersize": 8},
    "dream_1.0": {"label": "dream, temperature 1", "color": "tab:orange", "marker": "s", "markersize": 4},
    HELD: {"label": "the recorded state's picture, held", "color": "0.3", "linestyle": "--"},
}
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SpotShares:
    """How the pictures of a source, so many decisions after recorded states, agree with the true ones in their spots.

    Of `true_spots` spots of `least` to `most` pixels in true pictures the source shows the share `shown`. Of its own
    `source_spots` the share `true` is true. A share of no spot is `None`.
    """

    source: str
    decisions: int
    least: int
    most: int
    shown: float | None
    true_spots: int
    true: float | None
    source_spots: int


@dataclass(frozen=True)
class DreamtSpots:
    """The shares by source, decisions and size, over so many recorded `states` of `drives`."""

    drives: int
    states: int
    shares: tuple[SpotShares, ...]


@dataclass(frozen=True)
class _Starts:
    """Recorded states of N rows, and what followed: `action` (N, AHEAD[-1], A), `true` pictures by decisions.

    `code` are those pictures, encoded and decoded.
    """

    latent: Floats
    state: Floats
    action: Floats
    held: Pictures
    true: Mapping[int, Pictures]
    code: Mapping[int, Pictures]


def measure_dreamt_spots(bundle: Bundle, drives: Iterable[EncodedRollout]) -> DreamtSpots | None:
    """Measure on drives until they have enough recorded states; `None` if none is long enough."""
    taken, left = list[EncodedRollout](), STATES
    for drive in islice(drives, MOST_DRIVES):
        if steps := len(_start_steps(drive)):
            taken.append(drive)
            left -= steps
        if left <= 0:
            break
    if not taken:
        return None
    decoder = Decoder(bundle)
    starts = _starts_of(bundle, decoder, taken)
    mean, deviation = measure_mean(np.concatenate([each.picture[each.first_informative_step :] for each in taken]))
    shares = []
    for source, decisions, shown in _pictures_of(bundle, decoder, starts):
        true = starts.true[decisions]
        kept, reverse = find_spots(true, shown, mean, deviation), find_spots(shown, true, mean, deviation)
        for size in SIZES:
            ours, others = kept.of_size(*size).kept, reverse.of_size(*size).kept
            shares.append(SpotShares(source, decisions, *size, _share(ours), len(ours), _share(others), len(others)))
    return DreamtSpots(len(taken), len(starts.latent), tuple(shares))


def _share(kept: NDArray[np.bool_]) -> float | None:
    return round(float(kept.mean()), 3) if len(kept) else None


def _start_steps(drive: EncodedRollout) -> range:
    """The steps of a drive that are followed by as many as are looked ahead."""
    return range(drive.first_informative_step, len(drive) - AHEAD[-1])


def _starts_of(bundle: Bundle, decoder: Decoder, drives: Sequence[EncodedRollout]) -> _Starts:
    """The recorded states of drives, each reached along its drive from the beginning."""
    picture, latent, action = (np.concatenate([getattr(d, n) for d in drives]) for n in ("picture", "mu", "action"))
    state = np.concatenate([each for drive in drives for _, _, each in follow_drive(bundle, drive)])
    begun = np.cumsum([0, *map(len, drives)])
    every = np.concatenate([first + np.array(_start_steps(d)) for first, d in zip(begun, drives, strict=False)])
    rows = every[np.linspace(0, len(every) - 1, min(STARTS, len(every))).astype(int)]
    actions = action[rows[:, None] + np.arange(AHEAD[-1])]
    later, index = np.unique(np.add.outer(AHEAD, rows), return_inverse=True)
    index = index.reshape(len(AHEAD), -1)
    true, code = (
        dict(zip(AHEAD, each[index], strict=True)) for each in (picture[later], decoder.decode(latent[later]))
    )
    return _Starts(latent[rows], state[rows], actions, picture[rows], true, code)


def _pictures_of(bundle: Bundle, decoder: Decoder, starts: _Starts) -> Iterator[tuple[str, int, Pictures]]:
    """Each source's pictures `(N, side, side, 3)` so many decisions after the recorded states."""
    for ahead in AHEAD:
        yield CODE, ahead, starts.code[ahead]
        yield HELD, ahead, starts.held
    model = DreamStep(bundle)
    for temperature in TEMPERATURES:
        noise, latent, state = EpisodeNoise(0, model.chance), starts.latent, starts.state
        for ahead, action in enumerate(np.moveaxis(starts.action, 1, 0), 1):
            draw = draw_rows(noise, len(latent))
            dream = model.imagine(latent, action, state, draw.uniform, draw.normal, temperature, draw.mask)
            latent, state = dream.latent, dream.state
            if ahead in AHEAD:
                yield f"dream_{temperature}", ahead, decoder.decode(latent)


def dreamt_spots_section(bundle: Bundle, drives: Iterable[EncodedRollout]) -> Section | None:
    """Draw the shares over the decisions; `None` as `measure_dreamt_spots`."""
    found = measure_dreamt_spots(bundle, drives)
    if found is None:
        return None
    figure, axes = new_figure(5.6, 2, len(SIZES), sharex=True, sharey=True)
    for column, (least, most) in enumerate(SIZES):
        for row, (share, count) in enumerate((("shown", "true_spots"), ("true", "source_spots"))):
            _draw_shares(axes[row, column], found, (least, most), share, count)
        axes[0, column].set_title(f"{least} to {most} pixels", fontsize=FONT + 1)
        axes[1, column].set_xlabel("decisions after the recorded state", fontsize=FONT)
    axes[0, 0].set_ylabel("share of true spots shown", fontsize=FONT)
    axes[1, 0].set_ylabel("share of shown spots true", fontsize=FONT)
    handles, _ = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles=handles, fontsize=FONT, loc="outside upper center", ncols=len(handles))
    first = {each.least: each.true_spots for each in found.shares if each.decisions == AHEAD[0]}
    counted = ", ".join(f"{first[least]} of {least} to {most} pixels" for least, most in SIZES)
    return Section(
        NAME, TITLE,
        f"Dreams go on from {plural(found.states, 'recorded state')} of {plural(found.drives, 'drive')} under the "
        "recorded actions, and their pictures are compared with the true ones. Top: the share of the true spots that "
        "a dream shows, in their places. Bottom: the share of a dream's own spots that are true. Grey is the true "
        "picture, encoded and decoded, which an exact dream would show. Dashed is the recorded state's picture, held: "
        f"a dream that is no better has predicted nothing. True spots after one decision: {counted}. Shares of fewer "
        f"than {FEWEST} spots are not drawn.",
        render_png(figure), {"dreamt_spots": asdict(found)},
    )  # fmt: skip


def _draw_shares(panel: Any, found: DreamtSpots, size: tuple[int, int], share: str, count: str) -> None:
    for source, look in LOOKS.items():
        among = [each for each in found.shares if each.source == source and (each.least, each.most) == size]
        values = [getattr(each, share) if getattr(each, count) >= FEWEST else np.nan for each in among]
        panel.plot([each.decisions for each in among], values, **look)
    if not any(np.isfinite(line.get_ydata()).any() for line in panel.get_lines()):
        panel.text(0.5, 0.5, f"fewer than {FEWEST} spots", ha="center", fontsize=FONT, transform=panel.transAxes)
    panel.set_xscale("log", base=2)
    panel.set_xticks(AHEAD, [str(each) for each in AHEAD])
    panel.set_ylim(-0.04, 1.04)
    panel.grid(alpha=0.3)
