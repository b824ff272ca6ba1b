"""Guess where a keyframe of one submap is in another one, by features of similar keyframes."""

from collections.abc import Sequence

from sigmasplat.data import se3
from sigmasplat.data.submap import Submap, SubmapStore
from sigmasplat.tracking.feature_image import FeatureImage, pose_by_features
from sigmasplat.tracking.features import Extractor
from sigmasplat.types import Matrix, Task, long_slice


class FeatureGuesses:
    """Guesses between submaps of one store; the features of an image are found once. extractor: None = no guesses;
    seed: of the pose from matches."""

    def __init__(self, store: SubmapStore, extractor: Extractor | None, seed: int) -> None:
        self.store, self.extractor, self.seed = store, extractor, seed
        self._images: dict[tuple[int, int], FeatureImage] = {}

    def of(self, own: Submap, keyframe: int, other: Submap, alike: Sequence[int]) -> Task[list[Matrix]]:
        """Return T_camera_other [4, 4] of a keyframe of `own` by each keyframe of `other` in `alike` whose features
        give a pose. A long slice ends after each image whose features are found."""
        guesses = list[Matrix]()
        if self.extractor is None or not alike:
            return guesses
        image = yield from self._with_features(own, keyframe, self.extractor)
        for k in alike:
            reference = yield from self._with_features(other, k, self.extractor)
            found = pose_by_features(reference.landmarks(self.extractor), image, self.extractor, self.seed)
            if found is not None:
                guesses.append(found.T_live_reference @ se3.inverse(other.T_submap_camera[k]))
        return guesses

    def _with_features(self, submap: Submap, keyframe: int, extractor: Extractor) -> Task[FeatureImage]:
        """Return the image of a keyframe when its features are found."""
        where = submap.index, keyframe
        if where not in self._images:
            image = self._images[where] = FeatureImage.of_picture(self.store.picture(*where), submap.camera)
            image.features(extractor)
            yield from long_slice()
        return self._images[where]
