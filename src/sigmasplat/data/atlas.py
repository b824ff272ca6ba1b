"""All poses: of submaps in the world, of keyframes in submaps, of frames relative to keyframes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sigmasplat.data import se3
from sigmasplat.data.camera import between
from sigmasplat.data.poses import Column, KeyframePoses, Place, Places, Poses
from sigmasplat.data.readout import AT_ONCE, Readout, Readouts
from sigmasplat.data.relative_pose import UNKNOWN_HOP, RelativePose, SolvedGraph, TrackedHops
from sigmasplat.types import Matrix


@dataclass(eq=False)
class Atlas:
    """Poses of submaps, keyframes and frames, each relative to the level above; world poses are computed on reading.

    anchors: T_world_submap of each submap, the first one the identity; closing a loop changes only these.
    odometry: the same poses from tracking alone; no loop changes them.
    keyframe_poses: T_submap_camera of each submap's keyframes; those of the last submap change while it is mapped.
    hops: one per keyframe: how tracking found it from the keyframe before it in the submap; readings: how its camera
    moved. places: one per frame.
    refined: T_submap_camera of the keyframes of each submap in the final map, as the graph of keyframes and refinement
    have moved them; the world poses of keyframes and of their frames then come from these.
    graph: of the keyframes of the world, once it is solved. follows: whether keyframes move while the graph grows.
    exposures: those of the same keyframes [K, 3, 2] relative to the final map (`data.camera`).
    components: one number per submap. Submaps of a component are connected, and their anchors are in one frame: the
    world for component 0, else the first camera of the component. A component joins another when a place is recognised.
    """

    anchors: Poses = field(default_factory=Poses)
    odometry: Poses = field(default_factory=Poses)
    keyframe_poses: KeyframePoses = field(default_factory=KeyframePoses)
    hops: TrackedHops = field(default_factory=TrackedHops)
    readings: Readouts = field(default_factory=Readouts)
    places: Places = field(default_factory=Places)
    components: list[int] = field(default_factory=list)
    refined: dict[int, list[Matrix]] = field(default_factory=dict)
    exposures: dict[int, Matrix] = field(default_factory=dict)
    graph: SolvedGraph | None = None
    follows: bool = False

    def begin_submap(self, T_parent_submap: Matrix | None = None, parent: int = -1) -> None:
        """Append a submap at its pose in a parent submap, the last one by default; without a pose, a new component
        begins with it."""
        for chain in (self.anchors, self.odometry):
            new = np.eye(4) if T_parent_submap is None else se3.orthonormalise(chain[parent] @ T_parent_submap)
            chain.append(new)
        begun = max(self.components, default=-1) + 1
        self.components.append(begun if T_parent_submap is None else self.components[parent])
        self.keyframe_poses.begin([])

    def add_finished(self, T_world_submap: Matrix, keyframe_poses: list[Matrix]) -> None:
        """Append a submap of an earlier session to the world, with T_submap_camera [4, 4] of its keyframes."""
        self.anchors.append(T_world_submap)
        self.odometry.append(T_world_submap)
        self.components.append(0)
        self.keyframe_poses.begin(keyframe_poses)
        for _ in keyframe_poses:
            self.hops.append(UNKNOWN_HOP)
            self.readings.append(AT_ONCE)

    def set_keyframes(self, keyframe_poses: list[Matrix], hop: RelativePose, reading: Readout = AT_ONCE) -> None:
        """Set T_submap_camera [4, 4] of the last submap's keyframes, with a new one at the end, and the hop to it."""
        self.hops.append(hop)
        self.readings.append(reading)
        self.keyframe_poses.newest = keyframe_poses

    def join(self, a: int, b: int, T_a_b: Matrix) -> None:
        """Join the components of two submaps, given T_a_b [4, 4]: the one with the higher number moves to the other."""
        if self.components[a] > self.components[b]:
            a, b, T_a_b = b, a, se3.inverse(T_a_b)
        kept, moved = self.components[a], self.components[b]
        for chain in (self.anchors, self.odometry):
            motion = chain[a] @ T_a_b @ se3.inverse(chain[b])
            for s, component in enumerate(self.components):
                if component == moved:
                    chain[s] = se3.orthonormalise(motion @ chain[s])
        self.components = [kept if component == moved else component for component in self.components]

    def copied(self) -> "Atlas":
        """Return a copy of the poses that later frames do not change; the places of frames are in the same memory."""
        return replace(
            self, anchors=self.anchors.copied(), keyframe_poses=self.keyframe_poses.copied(),
            places=self.places.first(len(self.places)), components=list(self.components), refined=dict(self.refined),
        )  # fmt: skip

    def members(self, component: int) -> list[int]:
        """Return the submaps of a component."""
        return [s for s, number in enumerate(self.components) if number == component]

    @property
    def columns(self) -> tuple[Column, ...]:
        """Return what grows with every frame or keyframe."""
        return self.keyframe_poses.rows, self.hops.rows, self.readings.rows, self.places.rows

    @property
    def in_world(self) -> NDArray[np.bool_]:
        """Return which frames are in a submap that is connected to the world, bool [F]."""
        return np.asarray(np.array(self.components, np.int64)[self.places.submap] == 0)

    def place_frame(self, T_submap_camera: Matrix) -> None:
        """Append a frame, relative to the newest keyframe of the last submap."""
        self.place_by_keyframe(se3.inverse(self.keyframe_poses.last[-1]) @ T_submap_camera)

    def place_again(self, T_submap_camera: Matrix) -> None:
        """Place the newest frame again: its pose is known better, or it has become a keyframe."""
        self.places.rows.count -= 1
        self.place_frame(T_submap_camera)

    def place_by_keyframe(self, T_keyframe_camera: Matrix) -> None:
        """Append a frame at its pose [4, 4] relative to the newest keyframe of the last submap."""
        place = Place(len(self.anchors) - 1, len(self.keyframe_poses.last) - 1, se3.orthonormalise(T_keyframe_camera))
        self.places.append(place)

    def T_world_camera(self, loops: bool = True) -> Matrix:
        """Return the poses of all frames [F, 4, 4]; without `loops` those of tracking alone."""
        return self._frames(self._in_world(*((self.anchors, self.refined) if loops else (self.odometry, {}))))

    def rates(self, frames: NDArray[np.int64]) -> Matrix:
        """Return how the camera moves in the time of a frame, at some frames of the world [N]: twists [N, 6] in its
        axes; 0 for frames below 0, which are of an earlier session."""
        found = se3.rates(self.T_world_camera(), np.arange(len(self.places)), np.maximum(frames, 0), self.in_world)
        return found * (frames >= 0)[:, None]

    @property
    def T_submap_camera(self) -> Matrix:
        """Return the poses of all frames in their submaps [F, 4, 4], to which the splats of the submaps were fitted."""
        return self._frames(self.keyframe_poses.stacked())

    @property
    def T_world_keyframes(self) -> Matrix:
        """Return the poses of all keyframes [K, 4, 4], submap by submap."""
        return self._in_world(self.anchors, self.refined)

    def T_world_keyframes_of(self, submaps: Sequence[int]) -> dict[int, Matrix]:
        """Return the poses of the keyframes [K, 4, 4] of some submaps, by submap."""
        poses, ends = self.T_world_keyframes, np.cumsum([0, *self.keyframe_poses.counts]).tolist()
        return {submap: poses[ends[submap] : ends[submap + 1]] for submap in submaps}

    def _in_world(self, anchors: Poses, refined: Mapping[int, Sequence[Matrix]]) -> Matrix:
        """Return the poses of all keyframes [K, 4, 4] in the world; refined: as the attribute."""
        poses, counts = self.keyframe_poses.stacked(), self.keyframe_poses.counts
        first = np.cumsum(counts) - counts
        for submap, moved in refined.items():
            poses[first[submap] : first[submap] + len(moved)] = moved
        return np.asarray(np.repeat(np.array(anchors), counts, axis=0) @ poses)

    def _frames(self, keyframe_poses: Matrix) -> Matrix:
        """Return the poses of all frames [F, 4, 4], given those [K, 4, 4] of the keyframes."""
        places = self.places.first(len(self.places))  # another thread may append some
        first = np.cumsum([0, *self.keyframe_poses.counts])
        row, last = first[places.submap] + places.keyframe, first[places.submap + 1] - 1
        if not (self.follows or self.refined):
            return np.asarray(keyframe_poses[row] @ places.T_keyframe_camera)
        return frame_poses(keyframe_poses, self.hops.T_camera_before, row, last, places.T_keyframe_camera)

    def frame_exposures(self) -> Matrix:
        """Return the exposures of all frames [F, 3, 2] relative to the final map, interpolated between keyframes."""
        first = dict[tuple[int, int], int]()
        places = zip(self.places.submap.tolist(), self.places.keyframe.tolist(), strict=True)
        for row, place in enumerate(places):
            first.setdefault(place, row)
        known = [(row, self.exposures[s][k]) for (s, k), row in first.items() if s in self.exposures]
        rows = np.array([row for row, _ in known], np.int64)
        exposures = np.array([exposure for _, exposure in known]).reshape(-1, 3, 2)
        return between(rows, exposures, np.arange(len(self.places)))


def between_keyframes(row: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.int64], Matrix]:
    """Return the row of the keyframe after each frame [F], and its share in the frame's motion: 0 at the keyframe.

    row [F]: of the frame's own keyframe, in the order of the frames; last [F]: that of the last one of its submap.
    """
    begins = np.append(np.flatnonzero(np.diff(row, prepend=-1)), len(row))  # frames of one keyframe are in a row
    share = np.concatenate([np.empty(0), *(np.arange(frames) / frames for frames in np.diff(begins))])
    return np.minimum(row + 1, last), share


def frame_poses(
    T_keyframe: Matrix, T_camera_before: Matrix, row: NDArray[np.int64], last: NDArray[np.int64], T_own: Matrix
) -> Matrix:
    """Return the poses of frames [F, 4, 4], which tracking found at T_own [F, 4, 4] from keyframes at [K, 4, 4].

    The next keyframe is not where tracking found it, at T_camera_before [K, 4, 4], because mapping and the graph of
    keyframes have moved both. The frames between take their share of this motion, so that the path does not jump. row,
    last: of `between_keyframes`.
    """
    after, share = between_keyframes(row, last)
    T_tracked = T_keyframe[row] @ se3.inverse(T_camera_before[after])
    moved = se3.exp_stack((share * (after > row))[:, None] * se3.log_stack(T_keyframe[after] @ se3.inverse(T_tracked)))
    return np.asarray(moved @ T_keyframe[row] @ T_own)
