"""Keep probe views: frames that were tracked without doubt and that the map is not fitted to."""

from dataclasses import dataclass, field, replace

import numpy as np

from sigmasplat.data.submap import Picture, Submap
from sigmasplat.fit.target import Target
from sigmasplat.types import Matrix


@dataclass(frozen=True, eq=False)
class ValidationView:
    """A frame that is not a keyframe: its number, its pose relative to the keyframe with number `keyframe` in the
    submap (T_keyframe_camera [4, 4]), and its images."""

    index: int
    keyframe: int
    T_keyframe_camera: Matrix
    picture: Picture


@dataclass(eq=False)
class ValidationViews:
    """The probe views of the active submap: at most `most`, one per keyframe, spread over the submap.

    every: frames between keyframes. The number of frames from a keyframe to its probe varies, so that probes are as
    near to keyframes as frames are on average. The farthest frames have larger errors than most.
    """

    most: int
    every: int
    kept: list[ValidationView] = field(default_factory=list)

    def offer(self, index: int, keyframe: int, since: int, T_keyframe_camera: Matrix, target: Target) -> None:
        """Keep a frame if it is nearer to the wanted distance from its keyframe than the one kept; since: frames since
        the keyframe."""
        if not self.wants(keyframe, since):
            return
        self.kept = [probe for probe in self.kept if probe.keyframe != keyframe]
        self.kept.append(ValidationView(index, keyframe, T_keyframe_camera, target.picture()))
        if len(self.kept) > self.most:
            self.kept.pop(self._most_crowded())

    def wants(self, keyframe: int, since: int) -> bool:
        """Return whether a frame may be kept, `since` frames after a keyframe."""
        return bool(self.most) and since <= 1 + keyframe % max(1, self.every - 1)

    def _most_crowded(self) -> int:
        """Return which probe to drop: the one nearest to its neighbours, but the newest only if it is the only one."""
        at = [self.kept[0].index - self.every, *(probe.index for probe in self.kept)]
        gaps = [at[k + 2] - at[k] if k + 2 < len(at) else np.inf for k in range(len(self.kept))]
        return int(np.argmin(gaps))

    def of(self, submap: Submap) -> tuple[Submap, list[Picture]]:
        """Return a finished submap with these probe views, and their images."""
        if not self.kept:
            return submap, []
        poses = np.stack([submap.T_submap_camera[p.keyframe] @ p.T_keyframe_camera for p in self.kept])
        frames = tuple(probe.index for probe in self.kept)
        return replace(submap, probe_frames=frames, T_submap_probe=poses), [probe.picture for probe in self.kept]
