"""Read the parts of a run that exports need: its camera, its path, and the images of its keyframes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

import sigmasplat.api as api
from sigmasplat.api import Camera, RunError, RunFrames, Trajectory


@dataclass(frozen=True, eq=False)
class RunReader:
    """A run whose files are read once."""

    run: api.RunFolder

    @cached_property
    def config(self) -> api.Config:
        """Return the run's settings."""
        return self.run.config()

    @cached_property
    def camera(self) -> Camera:
        """Return the camera at the run's working resolution."""
        if len(self.run.submaps):
            return self.run.submaps.load(0).camera
        path, settings = self.run.path / "run.json", self.config.input
        with api.guarded(path, "run it again", RunError, "its camera cannot be used"):
            return Camera(**self.run.facts()["camera"]).prepared(settings.width, settings.crop_px)

    @cached_property
    def frames(self) -> RunFrames:
        """Return the frames of the run. Raises RunError if it has no path, or if its log is shorter than its path."""
        path = self.run.read_trajectory()
        log = self.run.read_log()
        if len(log) < len(path):
            raise RunError(f"run {self.run.path}: its log has {len(log)} frames, its path {len(path)} poses")
        return RunFrames.of(log, path)

    def valid_frames(self) -> list[int]:
        """Return the frames whose pose is valid, counted from the run's start. Raises RunError if there is none."""
        if not len(self.frames.rows):
            raise RunError(
                f"run {self.run.path} has no frame whose pose is known in its world, so it has no pose to export; "
                "run it again"
            )
        return [int(row) for row in self.frames.rows]

    def valid_path(self) -> Trajectory:
        """Return the poses of `valid_frames`. Raises RunError if there is none."""
        self.valid_frames()
        return self.frames.path

    def poses_of(self, frames: Sequence[int]) -> Trajectory:
        """Return the poses of some frames. Raises RunError if the pose of one is not valid."""
        if unknown := sorted(set(frames) - set(self.valid_frames())):
            raise RunError(f"run {self.run.path} has no valid pose of frame {unknown[0]}; choose another frame")
        return self.frames.path.at(np.searchsorted(self.frames.rows, frames))

    def covariances(self) -> api.Matrix:
        """Return the covariance of the poses of `valid_path` [B, 6, 6], of left twists in the world, m and rad.

        Raises RunError if the run did not record the errors of its path.
        """
        rows = self.valid_frames()
        errors = api.PathCovariance.of(self.run.read_checkpoint()[0])
        if errors is None or len(errors) <= rows[-1]:
            raise RunError(
                f"run {self.run.path} did not record the errors of its path, because an older version made it; "
                "run it again"
            )
        return np.stack([errors.of_frame(row) for row in rows])

    def left_out(self, keyframes: bool = False) -> str:
        """Describe how many frames have no valid pose, of all or of the keyframes; empty if there are none."""
        log, states = self.frames.log, self.frames.states
        counted = [s for s, record in zip(states, log, strict=True) if not keyframes or record["is_keyframe"]]
        found = [f"{counted.count(state):,} {state}" for state in (api.LOST, api.APART) if state in counted]
        return f"; left out: {', '.join(found)}" if found else ""

    def count_keyframes(self) -> int:
        """Return the number of keyframes that `keyframes` yields."""
        return sum(bool(record["is_keyframe"]) for record in self.frames.log)

    def keyframes(self) -> Iterator[tuple[int, api.Picture]]:
        """Yield each keyframe once, in order of time: its frame number, and its images, one at a time in memory.

        Raises RunError if the run kept no submaps, which contain the images.
        """
        if not len(self.run.submaps):
            raise RunError(f"run {self.run.path} kept no submaps, so it has no images; leave out --pictures")
        seen = set[int]()
        for index in range(len(self.run.submaps)):
            for k, frame in enumerate(self.run.submaps.load(index).frames):
                # Submaps share the keyframe between them. Frame numbers below 0 belong to an earlier session.
                if 0 <= frame < len(self.frames) and frame not in seen:
                    seen.add(frame)
                    yield frame, self.run.submaps.picture(index, k)
