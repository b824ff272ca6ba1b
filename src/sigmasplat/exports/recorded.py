"""Read of a run what exports need: where the camera was, what it was, what its keyframes saw."""

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
class Recorded:
    """A run and, where it kept no submaps, the sequence it was made of, opened when first needed."""

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
        """Return the camera of the images that the run worked on."""
        if len(self.run.submaps):
            return self.run.submaps.load(0).camera
        return self.source.camera.prepared(self.config.input.width, self.config.input.crop_px)

    @cached_property
    def path(self) -> Trajectory:
        """Return the poses of all frames. Raises RunError if the run has none."""
        return self.run.read_trajectory()

    def frames(self) -> list[int]:
        """Return the frames whose poses are to be trusted, counted from the run's start: those that were not lost.

        Raises RunError if there is none, or log and path are not of one run.
        """
        log = self.run.read_log()
        if len(log) < len(self.path):
            raise RunError(f"run {self.run.path}: its log has {len(log)} frames, its path {len(self.path)} poses")
        found = [i for i, record in enumerate(log[: len(self.path)]) if not record.get("lost")]
        if not found:
            raise RunError(f"run {self.run.path} was lost on every frame: there is no pose to export; run it again")
        return found

    def trusted_path(self) -> Trajectory:
        """Return the poses of `frames`."""
        frames = self.frames()
        return Trajectory(self.path.timestamps_s[frames], self.path.T_world_camera[frames])

    def count_keyframes(self) -> int:
        """Return how many keyframes `keyframes` gives."""
        return sum(bool(record["is_keyframe"]) for record in self.run.read_log()[: len(self.path)])

    def keyframes(self) -> Iterator[tuple[int, Picture]]:
        """Return what each keyframe saw, in the order of the frames, each once, one in memory at a time."""
        if not len(self.run.submaps):
            yield from self._read_again()
            return
        seen = set[int]()
        for index in range(len(self.run.submaps)):
            for k, frame in enumerate(self.run.submaps.load(index).frames):
                if frame < len(self.path) and frame not in seen:  # the next submap begins with the last one's end
                    seen.add(frame)
                    yield frame, self.run.submaps.picture(index, k)

    def _read_again(self) -> Iterator[tuple[int, Picture]]:
        """Read the keyframes from the sequence."""
        s = self.config.input
        for i, record in enumerate(self.run.read_log()[: len(self.path)]):
            if record["is_keyframe"]:
                read = self.source.frame(record["index"])
                frame = read.prepared(s.width, s.min_depth_m, s.max_depth_m, s.crop_px)
                color = np.rint(frame.color * np.float32(255.0)).astype(np.uint8)
                yield i, Picture(color, frame.depth_m)
