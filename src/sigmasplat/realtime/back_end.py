"""The clock of the map: place tracked frames, map keyframes, search for lost cameras; in slices."""

import queue
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.relative_pose import UNKNOWN_HOP
from sigmasplat.data.trajectory import APART, RELOCALISED
from sigmasplat.fit.align import Alignment
from sigmasplat.fit.pose import fit_pose_align
from sigmasplat.graph.path_covariance import NO_ERRORS
from sigmasplat.realtime.front_end import Snapshot, TrackedFrame
from sigmasplat.slam.mapping_backend import SLICES_PER_FRAME
from sigmasplat.slam.results import StepTimer
from sigmasplat.system.array_interface import Correction, correction_since
from sigmasplat.system.slam import Slam
from sigmasplat.tracking.newest_frame import AS_GOOD, NewestFrame
from sigmasplat.tracking.prepared_frame import PreparedFrame, TrackedKeyframe, mapped_keyframe
from sigmasplat.tracking.relocaliser import Relocation
from sigmasplat.types import Matrix

MOST_ADDED = 4
"""Largest number of keyframes in a row that are added without a fit. Without this limit, a map that falls behind never
catches up, because tracking gets no newer reference."""


class BackEnd:
    """Does the work that tracking hands over, in the order of the frames. It owns the map, the atlas and the store.

    with_errors: whether snapshots contain the errors of poses.
    """

    def __init__(self, system: Slam, publish: Callable[[Snapshot], None]) -> None:
        self.system, self.publish = system, publish
        self.given: queue.SimpleQueue[TrackedFrame | Callable[[], None]] = queue.SimpleQueue()
        self.last: Snapshot | None = None
        self.with_errors = False
        self._before = system.atlas.copied()
        self._pending: deque[TrackedFrame | Callable[[], None]] = deque()
        self._spare, self._added = 0, 0
        self._undescribed: TrackedKeyframe | None = None
        self._found = -1
        self._timer = StepTimer()

    def slices(self) -> Iterator[bool]:
        """Work in slices without end: yield True after a slice, False when nothing is left to do for now."""
        while True:
            while self._take():
                each = self._pending.popleft()
                if isinstance(each, TrackedFrame):
                    for _ in self._handled(each):
                        yield True
                else:  # work between two frames, when all earlier frames are in the map
                    each()
                yield True
            for _ in self._spare_work():
                yield True
            if not self._take():
                yield False

    def _take(self) -> bool:
        """Take over what was given; return whether anything is to be done."""
        while True:
            try:
                self._pending.append(self.given.get_nowait())
            except queue.Empty:
                return bool(self._pending)

    def _keyframe_waits(self) -> bool:
        self._take()
        return any(isinstance(each, TrackedFrame) and each.offer is not None for each in self._pending)

    # ---- frames ----

    def _handled(self, each: TrackedFrame) -> Iterator[None]:
        """Place a frame, map it if it is a keyframe, search for it if it is lost.

        A keyframe that was tracked before tracking knew where the camera was found is only placed: its pose relative to
        the found frame is a guess.
        """
        if each.offer is not None and each.based_on >= self._found:
            yield from self._map(each, each.offer)
            return
        self._place(each)
        if each.search is not None:
            yield from self._search(each, each.search)
        yield from self.system.refining(self.system.mapper.pending_now, self._keyframe_waits)
        yield from self.system.closing(SLICES_PER_FRAME)

    def _place(self, each: TrackedFrame) -> None:
        system, number = self.system, self._newest
        T_keyframe_camera = se3.inverse(each.poses[number]) @ each.T_submap_camera
        system.atlas.place_by_keyframe(T_keyframe_camera)
        system.steps.append(each.step)
        if each.shown is not None:
            last = len(system.mapper.keyframes) - 1
            system.validation_views.offer(each.number, last, each.number - number, T_keyframe_camera, each.shown)

    @property
    def _newest(self) -> int:
        return self.system.mapper.keyframes[-1].index

    def _pose(self, each: TrackedFrame) -> Matrix:
        """Return a frame's pose in the active submap, whose keyframes mapping may have moved since it was tracked."""
        known, T_submap_keyframe = each.poses[self._newest], self.system.atlas.keyframe_poses.last[-1]
        if np.array_equal(known, T_submap_keyframe):
            return each.T_submap_camera
        return T_submap_keyframe @ se3.inverse(known) @ each.T_submap_camera

    def _realigned(self, each: TrackedFrame, offer: NewestFrame) -> tuple[Matrix, Alignment | None]:
        """Return a keyframe's pose and its alignment to the keyframe before it. Both are fitted again, with the weights
        of that keyframe's pixels, if it was not mapped yet when the frame was tracked: errors of keyframes add up."""
        T, first, last = self._pose(each), offer.alignment, self.last
        if first is None or last is None or offer.seen.frame.T_given_camera is not None:
            return T, first
        reference, with_weights = last.keyframe.reference, each.based_on >= self._newest
        if with_weights or last.newest != self._newest:
            return T, first
        fit = fit_pose_align(reference, offer.seen.live, se3.inverse(T), self.system.config.tracking)
        if fit.alignment is None or fit.agreement * fit.overlap < AS_GOOD * first.agreement * first.overlap:
            return T, first
        return se3.orthonormalise(se3.inverse(fit.T_camera_world)), fit.alignment

    def _map(self, each: TrackedFrame, offer: NewestFrame) -> Iterator[None]:
        """Map a keyframe. If another one waits, it is only added to the map, and the fit is left to a later one, unless
        the submap ends: loops do not correct the drift within a submap."""
        system, number = self.system, each.number
        self._timer = system.start_timer()
        seen, first = offer.seen, not system.steps
        if system.config.tracking.exposure and system.config.mapping.colors == "code":
            seen = seen.without_exposure(offer.exposure)
        if first:
            place = system.begin_first(seen)
            state, T, hop = ("" if place is None else RELOCALISED), np.eye(4), UNKNOWN_HOP
        else:
            state, (T, alignment) = "", self._realigned(each, offer)
            hop = system.hop_to(se3.inverse(T), alignment, offer.wrong, offer.reference)
            if system.cuts:
                system.add_drift(T, alignment)
        may_wait = not first and self._added < MOST_ADDED and not system.submap_ends(number, T)
        if may_wait and self._keyframe_waits():
            system.add_keyframe(seen, number, T, hop)
            self._added += 1
            self._done(each)
            return
        self._added = 0
        T = yield from system.map_keyframe(seen, number, T, hop, self._keyframe_waits)
        if system.submap_ends(number, T):
            yield from system.cut(T, self._keyframe_waits)
            T = yield from system.map_keyframe(seen, number, np.eye(4), should_stop=self._keyframe_waits)
        yield from system.seek_component(seen, T)
        self._done(each)
        self._spare = system.config.realtime.spare_iterations
        self._publish(number, self._reference(seen, T, offer), {number: T}, state)

    def _done(self, each: TrackedFrame) -> None:
        """Place a keyframe, which is the newest one."""
        self.system.atlas.place_frame(self.system.atlas.keyframe_poses.last[-1])
        self.system.steps.append(each.step)

    def _reference(self, seen: PreparedFrame, T_submap_camera: Matrix, offer: NewestFrame | None) -> TrackedKeyframe:
        system, front = self.system, None if offer is None else offer.front
        c = system.config.tracking
        self._undescribed = mapped_keyframe(system.mapper.field.params, system.view, seen, T_submap_camera, c, front)
        return self._undescribed

    def _described(self, keyframe: TrackedKeyframe) -> TrackedKeyframe:
        """Find the features of a keyframe, so that tracking does not have to."""
        extractor = self.system.closer.extractor
        if keyframe.image is not None and extractor is not None:
            keyframe.image.landmarks(extractor)
        return keyframe

    def _spare_work(self) -> Iterator[None]:
        """Find the features of the newest keyframe, which take longer than its fit, and fit the map further, while no
        keyframe waits."""
        if self._undescribed is not None:
            keyframe, self._undescribed = self._undescribed, None
            self._described(keyframe)
            yield
        if self._spare and self.system.mapper.keyframes:
            steps, self._spare = self._spare, 0
            yield from self.system.mapper.refining(self.system.view, steps, self._keyframe_waits)

    # ---- lost and found ----

    def _tracked_again(self) -> bool:
        """Return whether a frame that waits was tracked: its pose, unlike that of a lost frame, needs no search."""
        self._take()
        return any(isinstance(each, TrackedFrame) and not each.step.lost for each in self._pending)

    def _search(self, each: TrackedFrame, seen: PreparedFrame) -> Iterator[None]:
        """Search the whole map for a frame, and tell tracking the result, unless the camera is tracked again."""
        system, number = self.system, each.number
        self._timer = system.start_timer()
        place = None if self._tracked_again() else (yield from system.relocalising(seen))
        yield
        if place is not None and not self._tracked_again():
            yield from self._go_to(place, number, seen)
        elif each.apart and not self._tracked_again():
            yield from system.begin_apart()
            yield from self._map_found(number, seen, APART)
        elif self.last is not None:
            last = replace(self.last, state="", searched=number, loops=system.loops.copied(), seconds=0.0)
            self._hand_over(replace(last, correction=None))

    def _go_to(self, place: Relocation, number: int, seen: PreparedFrame) -> Iterator[None]:
        system = self.system
        if place.where[0] == len(system.store):
            c, params = system.config.tracking, system.mapper.field.params
            keyframe = self._described(place.keyframe.weighed(params, system.view, c))
            newest = {self._newest: system.atlas.keyframe_poses.last[-1]}
            system.found_at(place)
            self._publish(number, keyframe, newest | {number: place.T_submap_camera}, RELOCALISED)
            return
        yield from system.branch_at(place)
        yield from self._map_found(number, seen, RELOCALISED)

    def _map_found(self, number: int, seen: PreparedFrame, state: str) -> Iterator[None]:
        """Begin a submap with a frame that was placed already, and publish it."""
        T = yield from self.system.map_keyframe(seen, number, np.eye(4), should_stop=self._keyframe_waits)
        self._publish(number, self._reference(seen, T, None), {number: T}, state)

    # ---- snapshots ----

    def correction(self) -> Correction | None:
        """Return how earlier poses have changed since the last call, if a function of the caller wants it."""
        before, self._before = self._before, self.system.atlas.copied()
        return correction_since(before, self.system.atlas) if self.system.listeners else None

    def _publish(self, number: int, keyframe: TrackedKeyframe, poses: dict[int, Matrix], state: str) -> None:
        """Hand a snapshot of the active map to tracking."""
        system, seconds = self.system, self._timer.stop(self.system.view)["total"]
        if state:
            self._found = number
        correction = self.correction()
        errors = system.pose_errors() if self.with_errors else NO_ERRORS
        self._hand_over(
            Snapshot(
                number, self._newest, poses, state, system.mapper.field.params.clone(), keyframe,
                system.active_submap(), system.confidence.newest, system.loops.copied(), number, seconds, errors,
                correction, system.graph.times,
            )
        )  # fmt: skip

    def _hand_over(self, snapshot: Snapshot) -> None:
        self.last = snapshot
        self.publish(snapshot)
