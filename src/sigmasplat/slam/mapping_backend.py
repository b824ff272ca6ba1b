"""The work on the map: map keyframes, cut submaps, close loops, search for lost cameras, join components.

Both clocks do this work: `Slam.step` between two frames, `RealTime` beside them. Long work is done in slices.
"""

from collections.abc import Sequence
from math import inf

import numpy as np

from sigmasplat.data import se3
from sigmasplat.data.field import GaussianField
from sigmasplat.data.readout import AT_ONCE, Readout
from sigmasplat.data.relative_pose import UNKNOWN_HOP, RelativePose
from sigmasplat.data.trajectory import evenly_spread
from sigmasplat.fit.align import Alignment
from sigmasplat.fit.pyramid import Pyramid
from sigmasplat.fit.references import Reference
from sigmasplat.fit.target import Keyframe
from sigmasplat.graph.closer import PendingSearch
from sigmasplat.graph.confidence import places_alike
from sigmasplat.graph.graph_errors import calibration_std, moved_by_camera
from sigmasplat.graph.keyframe_graph import WINDOW
from sigmasplat.mapping.mapper import Mapper
from sigmasplat.slam.slam_state import SlamState
from sigmasplat.tracking.drift import UNKNOWN, Drift
from sigmasplat.tracking.keyframe_rule import ends_submap
from sigmasplat.tracking.prepared_frame import PreparedFrame
from sigmasplat.tracking.recovery import usable
from sigmasplat.tracking.relocaliser import INDEX_AT_MOST, KnownMap, Relocation
from sigmasplat.types import Matrix, ShouldStop, Task, at_once, completed, never

SLICES_PER_FRAME = 3
"""Each frame that is not a keyframe continues the search for the loops of finished submaps by this many slices for each
submap that waits (`mapping.divided`). A slice is one alignment."""
SAME = 1e-9
"""Keyframes whose poses differ by less are copies of one, which two submaps share."""
LAST_TRIES = 3
"""At the end, other components are searched with this many keyframes of each submap that is apart."""


class MappingBackend(SlamState):
    """What changes the map, the atlas and the store. None of it changes the tracker."""

    # ---- keyframes ----

    def map_keyframe(
        self, seen: PreparedFrame, index: int, T_submap_camera: Matrix, hop: RelativePose = UNKNOWN_HOP,
        should_stop: ShouldStop = never,
    ) -> Task[Matrix]:  # fmt: skip
        """Map frame number `index`, which `hop` leads to, in slices; return its pose, which mapping may have moved.

        should_stop: as in `Mapper.mapping`.
        """
        keyframe = self._keyframe(seen, index, T_submap_camera)
        if self.follows and self.mapper.keyframes:
            with self._timer.stage("graph"):
                yield from self._align(keyframe, seen, hop, should_stop)
        with self._timer.stage("map"):
            fit = yield from self.mapper.mapping(self.view, keyframe, should_stop)
        self._timer.add(fit.seconds, prefix="map_")
        return self._placed(index, hop, seen)

    def keyframe_image(self, row: int) -> Pyramid:
        """Return the images of a keyframe of a finished submap; row: in `Atlas.T_world_keyframes`."""
        ends = np.cumsum(self.atlas.keyframe_poses.counts)
        submap = int(np.searchsorted(ends, row, side="right"))
        k = int(row - ends[submap] + self.atlas.keyframe_poses.counts[submap])
        readout = self.graph.times.read(self.atlas.readings[row])
        return self.images.of(row, self.view, lambda: self.store.picture(submap, k)).read(readout)

    def _align(self, keyframe: Keyframe, seen: PreparedFrame, hop: RelativePose, should_stop: ShouldStop) -> Task[None]:
        """Align a keyframe to earlier ones that see the same, in slices, and move the newest keyframes of the active
        submap to where all agree best. Once the times of the sensor are known, move all of them, and seed again."""
        atlas, anchor, active = self.atlas, self.atlas.anchors[-1], [*self.mapper.keyframes, keyframe]
        T_world_keyframe = np.stack([*atlas.T_world_keyframes, anchor @ keyframe.T_world_camera])
        newest = len(T_world_keyframe) - 1
        usable = np.repeat(atlas.components, atlas.keyframe_poses.counts) == atlas.components[-1]
        usable &= (np.abs(T_world_keyframe[1:] - T_world_keyframe[:-1]) > SAME).any((1, 2))  # of two copies the second
        rows = np.append(np.flatnonzero(usable), newest)
        noise = seen.live.noise_per_m / self.view.options.depth_noise_per_m

        def reading_of(row: int) -> Readout:
            return seen.reading if row == newest else atlas.readings[row]

        def image(row: int) -> Pyramid:
            k = row - newest - 1
            if -k > len(active):
                return self.keyframe_image(row).noisier(noise)
            target, readout = active[k].target, self.graph.times.read(reading_of(row))
            return self.images.of(row, self.view, target.picture, target.valid_pixels).read(readout).noisier(noise)

        yield from self.graph.aligning(T_world_keyframe, rows, image, should_stop)
        times = self.graph.times
        if self.graph.is_due:
            self.correct_motions()
            yield from self.graph.measuring(image, reading_of)
            yield from self._read_at_once()
        all_again = self.graph.times != times
        first = max(newest + 2 - len(active), 0 if all_again else newest + 1 - WINDOW)
        poses = self.graph.solved(T_world_keyframe, [*atlas.hops[first:], hop], first)
        moved = se3.orthonormalise(se3.inverse(anchor) @ poses)
        for each, T_submap_camera in zip(active[first - newest - 1 :], moved, strict=True):
            each.T_world_camera = T_submap_camera
        if all_again:
            yield from self.mapper.seeding_again(self.view)

    def correct_motions(self) -> None:
        """Let the keyframes so far have moved as the frames before and after them say. The motion of tracking, from the
        frame before alone, is noisier and comes earlier, which makes the times of a sensor too short."""
        atlas = self.atlas
        submap, keyframe = atlas.places.submap, atlas.places.keyframe
        first = np.cumsum([0, *atlas.keyframe_poses.counts])
        rows, frames = np.unique(first[submap] + keyframe, return_index=True)
        known = (np.array(atlas.components)[submap] == atlas.components[-1]) & ~self.steps.lost
        rows, frames = rows[known[frames]], frames[known[frames]]
        rates = se3.rates(atlas.T_world_camera(), self.steps.timestamps_s, frames, known)
        atlas.readings.correct(rows, rates)
        copied = np.isin(rows, first[1:-1]) & ~np.isin(rows - 1, rows)  # the last of a submap is the first of the next
        atlas.readings.correct(rows[copied] - 1, rates[copied])

    def _read_at_once(self) -> Task[None]:
        """Rewrite the keyframes of the active submap that were mapped before it was known when the sensor reads, in
        slices of one."""
        readings, first = self.atlas.readings, len(self.atlas.readings) - len(self.mapper.keyframes)
        for row, keyframe in enumerate(self.mapper.keyframes, first):
            readout = self.graph.times.read(readings[row])
            if readout is not None:
                keyframe.target = keyframe.target.read_at_once(readout)
                self.images.kept.pop(row, None)
                readings.correct(row, AT_ONCE.rate)
                yield

    def add_keyframe(self, seen: PreparedFrame, index: int, T_submap_camera: Matrix, hop: RelativePose) -> Matrix:
        """Add frame number `index` to the keyframes of the active submap without fitting the map; return its pose."""
        self.mapper.add(self.view, self._keyframe(seen, index, T_submap_camera))
        return self._placed(index, hop, seen)

    def refining(self, steps: int, should_stop: ShouldStop = never) -> Task[None]:
        """Make this many of the pending steps of the active submap's keyframes, in slices, until `should_stop`
        returns True."""
        if steps:
            with self._timer.stage("map"):
                yield from self.mapper.refining(self.view, steps, should_stop)

    def _keyframe(self, seen: PreparedFrame, index: int, T_submap_camera: Matrix) -> Keyframe:
        frame = seen.frame
        with self._timer.stage("describe"):
            descriptor = self.descriptor.describe(frame.color, frame.depth_m) if self._describes else None
        detail = None if seen.image is None else seen.image.detail
        with self._timer.stage("map"):
            photo = seen.photo(self.config)
        return Keyframe(index, seen.target, T_submap_camera, descriptor=descriptor, detail=detail, photo=photo)

    def _placed(self, index: int, hop: RelativePose, seen: PreparedFrame) -> Matrix:
        """Write the poses of the active submap's keyframes to the atlas; return that of the newest."""
        is_new = self.keyframe_indices[-1:] != [index]  # a keyframe that two submaps share is counted once
        if is_new:
            self.keyframe_indices.append(index)
        self.atlas.set_keyframes([keyframe.T_world_camera for keyframe in self.mapper.keyframes], hop, seen.reading)
        number = len(self.atlas.readings) - 1
        aligned = [edge.b for edge in self.graph.edges.touching(number)]
        alike = places_alike(seen.live) if is_new and self.config.tracking.verify else 1
        self.confidence.placed(number, hop.wrong, aligned, alike)
        return self.atlas.keyframe_poses.last[-1]

    def hop_to(
        self, T_camera_submap: Matrix, alignment: Alignment | None, wrong: float, reference: Reference | None = None
    ) -> RelativePose:
        """Return the motion from the newest keyframe to a new one, with its errors; alignment: of the new one to
        `reference`, which is an earlier keyframe if the camera was found there: then the motion contains the hops from
        it to the newest one; wrong: the probability that the motion is wrong."""
        poses, hops = self.atlas.keyframe_poses.last, self.atlas.hops
        T_camera_before = T_camera_submap @ poses[-1]
        if alignment is None:
            return RelativePose.hop(T_camera_before, wrong=wrong)
        covariance, since = alignment.covariance, [] if reference is None else poses[reference.keyframe :][1:]
        for T_submap_keyframe, hop in zip(since, hops[len(hops) - len(since) :], strict=True):
            A, known = se3.adjoint(T_camera_submap @ T_submap_keyframe), hop.total_covariance
            covariance = covariance + A @ (UNKNOWN if known is None else known) @ A.T
        errors, camera = [covariance, alignment.bias], calibration_std(self.config.input, self.view.camera)
        if camera is not None:
            errors.append(camera * moved_by_camera(T_camera_before, alignment.pair.reference.points))
        return RelativePose.hop(T_camera_before, *errors, wrong=wrong)

    def add_drift(self, T_submap_camera: Matrix, alignment: Alignment | None) -> float:
        """Add the hop to a keyframe to the submap's drift; return the standard deviation of its position, metres.
        alignment: as of `hop_to`."""
        self.drift.hop(T_submap_camera, None if alignment is None else alignment.covariance)
        return self.drift.position_m(T_submap_camera)

    # ---- submaps ----

    def submap_ends(self, index: int, T_submap_camera: Matrix) -> bool:
        """Return whether a rule ends the active submap at frame number `index`."""
        since, moved_m = index - self.mapper.keyframes[0].index, self.drift.position_m(T_submap_camera)
        return bool(ends_submap(T_submap_camera, since, moved_m, self.config.submaps))

    def cut(self, T_submap_camera: Matrix, should_stop: ShouldStop = never) -> Task[None]:
        """Finish the active submap (`finish_submap`) and start the next one at its newest keyframe, in slices. A next
        submap that inherits splats also makes the pending steps of this keyframe."""
        inherited = None
        if self.config.submaps.inherit:
            inherited, self.mapper.half = self.mapper.half, None
        start = RelativePose(len(self.store), len(self.store) + 1, T_submap_camera, self.drift.information)
        yield from self.branch(start, self.mapper.field, should_stop)
        self.mapper.half = inherited

    def branch(self, start: RelativePose, field: GaussianField, should_stop: ShouldStop = never) -> Task[None]:
        """Finish the active submap (`finish_submap`) and start the next one at the camera, in slices.

        start: the pose of the next submap in the one that it is connected to; field: that one's splats, which the new
        submap may inherit.
        """
        with self._timer.stage("cut"):
            yield from self.finish_submap(should_stop)
            self.begin_at(start, field)

    def branch_at(self, place: Relocation) -> Task[None]:
        """Finish the active submap and start the next one where the camera was found, in slices."""
        self.found_at(place)
        return self.branch(place.relative_pose(len(self.store) + 1), self._splats_of(place))

    def found_at(self, place: Relocation) -> None:
        """Take note of where the camera was found."""
        submap, k = place.where
        self.confidence.begins(int(np.sum(self.atlas.keyframe_poses.counts[:submap])) + k)

    def begin_at(self, start: RelativePose, field: GaussianField) -> None:
        """Start a submap at the camera, connected to another one, as `branch` does."""
        self.closer.edges.append(start)
        self.atlas.begin_submap(start.T_a_b, start.a)
        self.mapper = Mapper(self.config, self.random, field).successor(self.view, start.T_a_b)
        self.drift = Drift(scene_scale=self.config.render.scene_scale)

    def begin_first(self, seen: PreparedFrame) -> Relocation | None:
        """Start the first submap of a session; return where the map of an earlier session shows the camera, if it
        does: the submap is connected to this place, else it begins a component."""
        place = self.relocalise(seen, index_at_most=None) if self.atlas.anchors else None
        if place is None:
            self._begin_component()
        else:
            self.begin_at(place.relative_pose(len(self.store)), self._splats_of(place))
        return place

    def begin_apart(self) -> Task[None]:
        """Finish the active submap and begin a component at the camera, in slices."""
        yield from self.finish_submap()
        self._begin_component()
        self.mapper = Mapper(self.config, self.random)
        self.drift = Drift(scene_scale=self.config.render.scene_scale)

    def _begin_component(self) -> None:
        """Begin a map at the camera, which is its origin."""
        self.atlas.begin_submap()
        self.confidence.begins()

    def finish_submap(self, should_stop: ShouldStop = never) -> Task[None]:
        """Move the active submap to the store, in slices, and look for its loops, or leave that to the next frames
        (`mapping.divided`). Pending steps are made before, unless `should_stop` returns True."""
        yield from self.refining(self.mapper.pending, should_stop)
        for row, keyframe in enumerate(self.mapper.keyframes, len(self.atlas.keyframe_poses.rows)):
            self.images.settle(row, keyframe.target.valid_pixels)
        submap, pictures = self.mapper.finished(len(self.store))
        submap, probes = self.validation_views.of(submap)
        yield
        self.store.save(submap, pictures, probes)
        self.validation_views.kept = []
        descriptors = [keyframe.descriptor for keyframe in self.mapper.keyframes]
        known = [descriptor for descriptor in descriptors if descriptor is not None]
        yield
        self.closer.pending.append(PendingSearch(submap.index, known))
        if not self.config.mapping.divided:
            yield from self.closing()

    def closing(self, at_most: int | None = None) -> Task[None]:
        """Look for the loops of finished submaps, one submap after the other; at most so many
        slices are made for each pending search. At the end of a search anchors may move."""
        left = inf if at_most is None else at_most * len(self.closer.pending)
        while self.closer.pending and left > 0:
            pending = self.closer.pending[0]
            if self._search is None:
                submap = self.store.load(pending.submap)
                self._search = self.closer.closing(submap, pending.descriptors, self.atlas, self.view)
                for _ in range(pending.slices):  # after a resume: what was done before
                    next(self._search)
            try:
                next(self._search)
            except StopIteration:
                self.closer.pending.pop(0)
                self._search = None
                continue
            pending.slices += 1
            left -= 1
            yield

    # ---- search and join ----

    def relocalising(
        self, seen: PreparedFrame, apart_from: int | None = None, index_at_most: int | None = INDEX_AT_MOST
    ) -> Task[Relocation | None]:
        """Search the map for the camera, in slices; apart_from: only in components that are not that of this submap."""
        if not self.config.recovery.relocalise or not usable(seen):
            return None
        components = self.atlas.components
        wanted = [apart_from is None or number != components[apart_from] for number in components]
        with self._timer.stage("relocalise"):
            result = yield from self.relocaliser.searching(self._known(wanted), self.view, seen, index_at_most)
            return result.found

    relocalise = at_once(relocalising)
    """Search the map as `relocalising` does, in one go."""

    def _known(self, wanted: Sequence[bool]) -> KnownMap:
        """Return the map as relocalisation reads it; wanted [S]: which submaps are searched."""
        active = self.mapper.keyframes, self.mapper.field
        return KnownMap(self.store, self.atlas.keyframe_poses, *active, wanted.__getitem__)

    def _splats_of(self, place: Relocation) -> GaussianField:
        return self.store.load(place.where[0]).field.to(self.view.sums.device)

    def seek_component(self, seen: PreparedFrame, T_submap_camera: Matrix) -> Task[None]:
        """Look for a place of another component, in slices; two observations that agree join the components."""
        if len(set(self.atlas.components)) > 1:
            yield from self._seek_link(seen, len(self.store), T_submap_camera)

    def _connect_components(self) -> None:
        """When all is mapped, search other components for the keyframes of those that are apart."""
        for s, poses in enumerate(self.atlas.keyframe_poses):
            for k in evenly_spread(range(len(poses)), LAST_TRIES):
                if self.atlas.components[s]:
                    known = self._known([True] * len(self.atlas.components))
                    seen = PreparedFrame.of_picture(known.picture((s, k)), self.view)
                    completed(self._seek_link(seen, s, known.T_submap_camera((s, k))))

    def _seek_link(self, seen: PreparedFrame, submap: int, T_submap_camera: Matrix) -> Task[None]:
        """Search other components for a camera of a submap, in slices; if a second observation agrees, join them."""
        place = yield from self.relocalising(seen, apart_from=submap)
        if place is None:
            return
        T_other_submap = place.T_submap_camera @ se3.inverse(T_submap_camera)
        link = RelativePose(place.where[0], submap, T_other_submap, place.information, "join")
        if self.recovery.confirms(link, self.atlas, self.config.render.scene_scale):
            yield from self.closing()
            self.atlas.join(link.a, link.b, link.T_a_b)
            self.closer.edges.append(link)
