"""Run SLAM with frames held back, and collect errors and predicted variances at views that the map was not fitted to.

Nothing here depends on a particular predictor: they are rows of `view_predictors.PREDICTORS`. The samples of a run are
scored together with those of other runs (`uncertainty_scores`), because temperatures come from other sequences.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from finished_run import FinishedRun, run_facts
from numpy.typing import NDArray
from splat_statistics import MapFacts, map_facts, splat_values
from surface_errors import surface_errors
from surface_predictors import surface_columns
from torch import Tensor
from unseen_views import UnseenView, away_views, held_back_views
from view_predictors import PREDICTORS, Predictor, SeenView, see

from sigmasplat.config import Config
from sigmasplat.config.find_preset import preset as preset_of
from sigmasplat.config.text import full_path, override, split_settings
from sigmasplat.data import se3
from sigmasplat.data.camera import NEUTRAL, exposed
from sigmasplat.data.field import GaussianField
from sigmasplat.data.submap import SubmapStore
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.errors import ConfigError
from sigmasplat.final.refinement import KeyframeReader
from sigmasplat.final.uncertainty import map_uncertainty
from sigmasplat.input.source import Source
from sigmasplat.plugins.evaluation.view_scores import COVERED_ALPHA
from sigmasplat.render import FieldRenderer
from sigmasplat.render.backend import make_view
from sigmasplat.types import Matrix, Progress, no_progress
from sigmasplat.uncertainty.map_uncertainty import MapUncertainty

Floats = NDArray[np.float32]

SEED = "{seed}"
RESERVED = ("seed", "input.limit", "input.hold_every")
HELD_BACK, AWAY = "held back", "away from the path"
FINAL, SUBMAPS, MESH = "final", "submaps", "mesh"
EXACT, FUSED = "true surface", "fused readings"
PIXELS_PER_VIEW = 5_000
"""At most this many pixels of a view, drawn at random, are scored: sorting stays fast."""
TRAINING_VIEWS = 40
"""At most this many keyframes of a map, evenly spread, teach the statistics of its splats."""


@dataclass(frozen=True)
class Job:
    """One run: the sequence as given and as opened, the seed, all settings; `given` names those that keep their values
    in every scene."""

    source: str
    path: str
    seed: int
    config: Config
    given: tuple[str, ...] = ()


@dataclass(frozen=True)
class Study:
    """What to measure: sequences, each with seeds 0, 1, …, and the settings that all runs share; `given` names those
    that keep their values in every scene."""

    sources: Sequence[str]
    config: Config
    seeds: int = 1
    limit: int | None = None
    hold_every: int = 8
    views: int = 24
    given: tuple[str, ...] = ()

    def jobs(self) -> list[Job]:
        """List the runs; {seed} in a sequence is replaced by the number."""
        numbers = [(source, seed) for source in self.sources for seed in range(self.seeds)]
        held = {"input.hold_every": str(self.hold_every), "input.limit": str(self.limit or 0)}
        return [
            Job(
                source, full_path(source.replace(SEED, str(seed))), seed,
                override(self.config, held | {"seed": str(seed)}), self.given,
            )
            for source, seed in numbers
        ]  # fmt: skip


def study_config(preset: str, settings: Sequence[str]) -> Config:
    """Return a preset's settings, changed by --set. Raises ConfigError for a setting that the benchmark itself sets."""
    given = split_settings(settings)
    for name in sorted(given.keys() & set(RESERVED)):
        raise ConfigError(f"the benchmark itself sets {name}; remove it (use --seeds, --limit or --hold-every)")
    return override(preset_of(preset), given)


@dataclass(frozen=True)
class Kind:
    """What a set of samples is about: the quantity ("color", "depth", "surface"), the map, and the kind of views; for
    surfaces the reference instead of views."""

    quantity: str
    map: str
    views: str


@dataclass(eq=False)
class Samples:
    """Pixels of many views: squared error [P, C] of C channels (3 of colour, 1 of depth), alpha [P], whether there is
    a depth reading [P], and the variance [P] that each predictor gives, by name.
    """

    squared_error: list[Floats] = field(default_factory=list)
    alpha: list[Floats] = field(default_factory=list)
    reading: list[Floats] = field(default_factory=list)
    variances: dict[str, list[Floats]] = field(default_factory=dict)

    def joined(self) -> dict[str, Floats]:
        """Return the arrays "squared_error", "alpha", "reading" and "variance NAME" of all views.

        Pixels are in random order. Sorting keeps the order of equal variances, so otherwise AUSE would depend on the
        order of the views.
        """
        parts = {"squared_error": self.squared_error, "alpha": self.alpha, "reading": self.reading}
        parts |= {f"variance {name}": values for name, values in self.variances.items()}
        order = np.random.default_rng(0).permutation(sum(map(len, self.alpha)))
        return {name: np.concatenate(values)[order] for name, values in parts.items()}


@dataclass(frozen=True, eq=False)
class Measured:
    """What a run gives: its facts for the file, and its samples by kind (`Samples.joined`)."""

    facts: dict[str, Any]
    samples: dict[Kind, dict[str, Floats]]


class RunMaps:
    """The maps of a finished run with their facts: the final map and the submaps."""

    def __init__(self, run: FinishedRun) -> None:
        self.run, config = run, run.config
        self.renderer = FieldRenderer(config.render, config.backend)
        self.view = make_view(config.backend, run.camera, config.render, variance=False)

    def final(self) -> MapFacts:
        """Return the facts of the map in the world."""
        members = self.run.members
        part, anchors = self.run.part(members, refined=True), [self.run.anchors[s] for s in members]
        return self._facts(self.run.field, part, anchors, self.run.uncertainty)

    def submap(self, index: int) -> MapFacts:
        """Return the facts of a submap in its own frame."""
        splats, part, whole = self.run.store.load(index).field, self.run.part([index]), self.run.uncertainty
        known = None
        if whole is not None:
            known = map_uncertainty(splats, part, [np.eye(4)], self.run.config, self.view, whole.calibration)
        return self._facts(splats, part, [np.eye(4)], known)

    def _facts(
        self,
        splats: GaussianField,
        part: SubmapStore,
        anchors: Sequence[Matrix],
        uncertainty: MapUncertainty | None,
    ) -> MapFacts:
        reader = KeyframeReader(part, anchors, self.view)
        chosen = [reader[i] for i in evenly_spread(range(len(reader)), TRAINING_VIEWS)]
        return replace(map_facts(splats, chosen, self.renderer), uncertainty=uncertainty)


def measure(
    run: FinishedRun,
    source: Source,
    most: int,
    predictors: Sequence[Predictor] = PREDICTORS,
    progress: Progress = no_progress,
) -> Measured:
    """Collect errors and predictions of a finished run at views that its map was not fitted to, and of its surface.

    Views: at most `most` of the frames held back (`input.hold_every`) whose pose is valid, and as many of the
    source's test views. Surface: `surface_errors`, if the true path is known. Calls `progress(views done, total)`.
    """
    maps, samples, random = RunMaps(run), dict[Kind, Samples](), np.random.default_rng(run.config.seed)
    views = {HELD_BACK: held_back_views(run, source, most), AWAY: away_views(run, source, most)}
    total = sum(map(len, views.values())) + len(views[HELD_BACK])
    final = maps.final()
    values = splat_values(final)
    for done, (kind, map_name, view, seen) in enumerate(_seen_views(maps, final, values, views), 1):
        exposure = view.exposure if map_name == FINAL else NEUTRAL
        for quantity, columns in _pixels(view, seen, exposure, predictors, random).items():
            _add(samples.setdefault(Kind(quantity, map_name, kind), Samples()), columns)
        progress(done, total)
    facts = run_facts(run, source) | {"views": {kind: len(some) for kind, some in views.items()}}
    found = {kind: some.joined() for kind, some in samples.items()}
    errors = surface_errors(run, source, maps.renderer)
    of_surface = None if errors is None else surface_columns(errors, final, values)
    if errors is not None and of_surface is not None:
        found[Kind("surface", MESH, EXACT if errors.exact else FUSED)] = of_surface
    return Measured(facts, found)


def _seen_views(
    maps: RunMaps, final: MapFacts, values: Mapping[str, Tensor], views: Mapping[str, Sequence[UnseenView]]
) -> Iterator[tuple[str, str, UnseenView, SeenView]]:
    """Render all views from the final map, and those that belong to a submap also from it."""
    for kind, some in views.items():
        for view in some:
            T_camera_world = se3.inverse(view.T_world_camera)
            yield kind, FINAL, view, see(final, values, view.frame.camera, T_camera_world, maps.renderer, view.exact)
    for index in sorted({view.submap for view in views[HELD_BACK]}):
        facts = maps.submap(index)
        values = splat_values(facts)
        for view in views[HELD_BACK]:
            if view.submap == index:
                T_camera_submap = se3.inverse(view.T_submap_camera)
                yield (
                    HELD_BACK,
                    SUBMAPS,
                    view,
                    see(facts, values, view.frame.camera, T_camera_submap, maps.renderer, view.exact),
                )


def _pixels(
    view: UnseenView, seen: SeenView, exposure: Matrix, predictors: Sequence[Predictor], random: np.random.Generator
) -> dict[str, dict[str, Floats]]:
    """Return error, alpha and predictions at random pixels, by quantity.

    Colour is scored on all pixels, in the exposure [3, 2] of the view relative to the map; depth where the view has a
    reading and the map covers the pixel.
    """
    alpha, frame = _array(seen.rendered.alpha), view.frame
    color_error2 = (exposed(_array(seen.rendered.color), exposure) - frame.color) ** 2
    known = (frame.depth_m > 0) & (alpha > COVERED_ALPHA)
    errors = {
        "color": (color_error2, np.arange(alpha.size)),
        "depth": (((_array(seen.depth_m) - frame.depth_m) ** 2)[..., None], np.flatnonzero(known)),
    }
    planes = {(p.quantity, p.name): _array(p.plane(seen)).ravel() for p in predictors}
    found = dict[str, dict[str, Floats]]()
    for quantity, (error2, rows) in errors.items():
        chosen = random.permutation(rows)[:PIXELS_PER_VIEW]
        reading = (frame.depth_m > 0).astype(np.float32)
        columns = {"squared_error": error2.reshape(-1, error2.shape[-1])[chosen]}
        columns |= {name: plane.ravel()[chosen] for name, plane in (("alpha", alpha), ("reading", reading))}
        mine = {name: plane[chosen] for (of, name), plane in planes.items() if of == quantity}
        found[quantity] = columns | {f"variance {name}": values for name, values in mine.items()}
    return found


def _add(samples: Samples, columns: Mapping[str, Floats]) -> None:
    """Append the pixels of a view."""
    samples.squared_error.append(columns["squared_error"])
    samples.alpha.append(columns["alpha"])
    samples.reading.append(columns["reading"])
    for name, values in columns.items():
        if name.startswith("variance "):
            samples.variances.setdefault(name.removeprefix("variance "), []).append(values)


def _array(plane: torch.Tensor) -> Floats:
    return np.asarray(plane.detach().cpu(), np.float32)
