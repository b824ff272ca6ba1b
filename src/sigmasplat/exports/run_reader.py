"""Read the parts of a run that exports need: its camera, its path, and the images of its keyframes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sigmasplat.config import Config
from sigmasplat.errors import RunError
from sigmasplat.io.runs import RunFolder
from sigmasplat.model.camera import Camera
from sigmasplat.model.submap import Picture
from sigmasplat.model.trajectory import Trajectory
from sigmasplat.sources.base import Source


@dataclass(frozen=True, eq=False)
class RunReader:
    """A run, and its sequence, which is opened only if the run kept no submaps."""

    run: RunFolder
    open_source: Callable[[], Source]

    @cached_property
    def source(self) -> Source:
        """Return the sequence."""
        return self.open_source()

    @cached_property
    def config(self) -> Config:
        """Return the run's settings."""
        return self.run.config()

    @cached_property
    def camera(self) -> Camera:
        """Return the camera at the run's working resolution."""
        if len(self.run.submaps):
            return self.run.submaps.load(0).camera
        return self.source.camera.prepared(self.config.input.width, self.config.input.crop_px)

    @cached_property
    def path(self) -> Trajectory:
        """Return the poses of all frames. Raises RunError if the run has none."""
        return self.run.read_trajectory()

    def tracked_frames(self) -> list[int]:
        """Return the frames that were not lost, counted from the run's start.

        Raises RunError if there is none, or if log and path have different lengths.
        """
        log = self.run.read_log()
        if len(log) < len(self.path):
            raise RunError(f"run {self.run.path}: its log has {len(log)} frames, its path {len(self.path)} poses")
        found = [i for i, record in enumerate(log[: len(self.path)]) if not record.get("lost")]
        if not found:
            raise RunError(f"run {self.run.path} was lost on every frame, so it has no pose to export; run it again")
        return found

    def tracked_path(self) -> Trajectory:
        """Return the poses of the frames that were not lost."""
        frames = self.tracked_frames()
        return Trajectory(self.path.timestamps_s[frames], self.path.T_world_camera[frames])

    def count_keyframes(self) -> int:
        """Return the number of keyframes that `keyframes` yields."""
        return sum(bool(record["is_keyframe"]) for record in self.run.read_log()[: len(self.path)])

    def keyframes(self) -> Iterator[tuple[int, Picture]]:
        """Yield each keyframe once, in order of time: its frame number, and its images, one at a time in memory."""
        if not len(self.run.submaps):
            yield from self._keyframes_of_sequence()
            return
        seen = set[int]()
        for index in range(len(self.run.submaps)):
            for k, frame in enumerate(self.run.submaps.load(index).frames):
                if frame < len(self.path) and frame not in seen:  # submaps share the keyframe between them
                    seen.add(frame)
                    yield frame, self.run.submaps.picture(index, k)

    def _keyframes_of_sequence(self) -> Iterator[tuple[int, Picture]]:
        """Read the keyframes from the sequence again."""
        s = self.config.input
        for i, record in enumerate(self.run.read_log()[: len(self.path)]):
            if record["is_keyframe"]:
                read = self.source.frame(record["index"])
                frame = read.prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
                color = np.rint(frame.color * np.float32(255.0)).astype(np.uint8)
                yield i, Picture(color, frame.depth_m)
