"""Measure the residuals of finished submaps, for weights by predicted variance."""

from collections.abc import Iterator
from dataclasses import dataclass, field as dataclass_field

from torch import Tensor

from sigmasplat.config import Config
from sigmasplat.data.map_uncertainty import Background
from sigmasplat.data.submap import SubmapStore
from sigmasplat.fit.predicted_variance import with_residuals
from sigmasplat.fit.splat_residuals import background_of, splat_residuals
from sigmasplat.fit.target import Keyframe, Target


@dataclass(eq=False)
class PredictedSubmaps:
    """Residuals of the submaps of a store, measured when a submap is first asked for: one pass over its keyframes."""

    config: Config
    store: SubmapStore
    _known: dict[int, tuple[Tensor, Background]] = dataclass_field(default_factory=dict)

    def rows(self, index: int) -> Tensor:
        """Return the rows of a submap's splats [N, 17] with their residuals in σ² (`with_residuals`).

        index: the number of the submap in the store.
        """
        return with_residuals(self.store.load(index).field.params, self._measured(index)[0])

    def background(self, index: int) -> Background:
        """Return mean and variance of the colours of a submap's keyframes."""
        return self._measured(index)[1]

    def _measured(self, index: int) -> tuple[Tensor, Background]:
        if index not in self._known:
            field, background = self.store.load(index).field, background_of(self._keyframes(index))
            found = splat_residuals(field, self._keyframes(index), self.config.render, self.config.backend)
            self._known[index] = found[:, 0].clone(), background
        return self._known[index]

    def _keyframes(self, index: int) -> Iterator[Keyframe]:
        submap = self.store.load(index)
        size = submap.camera.height, submap.camera.width
        for k, T_submap_camera in enumerate(submap.T_submap_camera):
            target = Target.of_picture(self.store.picture(index, k), submap.camera, size)
            yield Keyframe(k, target, T_submap_camera, fixed=True)
