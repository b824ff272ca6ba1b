"""Store finished submaps on disk, one file each, which can be read in parts."""

import json
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sigmasplat.data.camera import Camera
from sigmasplat.data.field import ATTRIBUTES, GaussianField, Rows
from sigmasplat.data.frame import Detail, Photo
from sigmasplat.data.submap import Picture, Submap
from sigmasplat.errors import RunError
from sigmasplat.files.atomic import make_folder
from sigmasplat.files.tensors import open_tensors, write_tensors

OURS = re.compile(r"submap-\d{5,}\.safetensors")
UNFINISHED = re.compile(rf"\.{OURS.pattern}\.part")
"""A file left by a run that was killed while it wrote a submap."""


class DiskStore:
    """A `data.submap.SubmapStore` in a folder: one file per submap with its splats, keyframe poses and images.

    The folder is created with the first submap. Images are read one at a time, so that memory does not grow with their
    number. Adam's state is not stored, because a finished submap is not optimised.

    in_background: whether a thread writes the files (`DiskStore.in_background`).
    """

    def __init__(self, folder: Path, in_background: bool = False) -> None:
        self.folder = folder
        self._count = 0
        """Number of submaps when they were last counted."""
        self._writer = ThreadPoolExecutor(1, "submaps") if in_background else None
        self._written: Future[None] | None = None

    def __len__(self) -> int:
        count, written = self._count, self._written
        if written is not None and not (written.done() and written.exception() is None):
            return count  # the newest file is not there yet, or could not be written
        # To count is to list the folder. Two files show whether submaps were added or removed since then.
        if not count or not self.path(count - 1).is_file() or self.path(count).is_file():
            self._count = len(self._named(OURS))
        return self._count

    def in_background(self) -> "DiskStore":
        """Return the store of this folder for a run that adds submaps: `save` does not wait until the file is on the
        disk. What reads that store waits for it; call `settle` before the folder is read otherwise."""
        return DiskStore(self.folder, in_background=True)

    def path(self, index: int) -> Path:
        """Return the path of a submap's file."""
        return self.folder / f"submap-{index:05d}.safetensors"

    def save(self, submap: Submap, pictures: list[Picture], probes: Sequence[Picture] = ()) -> None:
        """Write a submap, which must be the next one. Raises RunError if it or the one before cannot be written."""
        self.settle()
        complete = len(submap.frames) == len(pictures) and len(submap.probe_frames) == len(probes)
        assert submap.index == len(self) and complete, "submaps are saved in their order, with all images"
        attributes = submap.field.attributes.items()
        tensors = {"params": submap.field.params, **{f"extra.{name}": values.params for name, values in attributes}}
        keyframes = "", "T_submap_camera", submap.frames, submap.T_submap_camera, pictures
        views = "probe_", "T_submap_probe", submap.probe_frames, submap.T_submap_probe, probes
        for prefix, poses, frames, T, images in (keyframes, views) if probes else (keyframes,):
            tensors |= {
                poses: torch.tensor(T, dtype=torch.float64),
                f"{prefix}frames": torch.tensor(frames, dtype=torch.int64),
                f"{prefix}colors": torch.from_numpy(np.stack([picture.color for picture in images])),
                f"{prefix}depths_m": torch.from_numpy(np.stack([picture.depth_m for picture in images])),
            }
        make_folder(self.folder)
        text = {"index": str(submap.index), "camera": json.dumps(asdict(submap.camera))}
        details = [picture.detail for picture in pictures if picture.detail is not None]
        if details and len(details) == len(pictures):
            tensors["details"] = torch.from_numpy(np.stack([detail.gray for detail in details]))
            text["detail_camera"] = json.dumps(asdict(details[0].camera))
        photos = [picture.photo for picture in pictures if picture.photo is not None]
        if photos and len(photos) == len(pictures):  # files of different lengths, one after the other
            tensors["photos"] = torch.from_numpy(np.concatenate([photo.jpeg for photo in photos]))
            tensors["photo_ends"] = torch.tensor([len(photo.jpeg) for photo in photos]).cumsum(0)
            text["photo_camera"] = json.dumps(asdict(photos[0].camera))
        if self._writer is None:
            write_tensors(self.path(submap.index), tensors, text)
        else:
            self._written = self._writer.submit(write_tensors, self.path(submap.index), tensors, text)
            self._count = submap.index + 1

    def settle(self) -> None:
        """Wait until what was saved is on the disk. Raises RunError if it cannot be written."""
        if self._written is not None:
            self._written.result()

    def load(self, index: int) -> Submap:
        """Read a submap without its images. Raises RunError if it is missing or damaged."""
        with self._opened(index) as file:
            kept = [name for name in ATTRIBUTES if f"extra.{name}" in file.keys()]  # noqa: SIM118
            attributes = {name: Rows(torch.from_numpy(file.get_tensor(f"extra.{name}"))) for name in kept}
            submap = Submap(
                index,
                GaussianField(torch.from_numpy(file.get_tensor("params")), attributes=attributes),
                tuple(file.get_tensor("frames").tolist()),
                file.get_tensor("T_submap_camera"),
                Camera(**json.loads(file.metadata()["camera"])),
            )
            if "probe_frames" not in file.keys():  # noqa: SIM118
                return submap
            frames, poses = file.get_tensor("probe_frames").tolist(), file.get_tensor("T_submap_probe")
            return replace(submap, probe_frames=tuple(frames), T_submap_probe=poses)

    def picture(self, index: int, keyframe: int) -> Picture:
        """Read the images of one keyframe. Raises RunError if the submap is missing or damaged."""
        with self._opened(index) as file:
            color, depth_m = (file.get_slice(name)[keyframe] for name in ("colors", "depths_m"))
            names, detail, photo = file.keys(), None, None
            if "details" in names:
                camera = Camera(**json.loads(file.metadata()["detail_camera"]))
                detail = Detail(file.get_slice("details")[keyframe], camera)
            if "photos" in names:
                ends = [0, *file.get_tensor("photo_ends").tolist()]
                camera = Camera(**json.loads(file.metadata()["photo_camera"]))
                photo = Photo(file.get_slice("photos")[ends[keyframe] : ends[keyframe + 1]], camera)
            return Picture(color, depth_m, detail, photo)

    def probe(self, index: int, probe: int) -> Picture:
        """Read the images of one probe view. Raises RunError if the submap is missing or damaged."""
        with self._opened(index) as file:
            return Picture(*(file.get_slice(name)[probe] for name in ("probe_colors", "probe_depths_m")))

    def truncate(self, count: int) -> None:
        """Remove all submaps except the first `count`, and incomplete files."""
        self.settle()
        for path in [self.path(index) for index in range(count, len(self))] + self._named(UNFINISHED):
            path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove all submaps and incomplete files, and the folder if it is then empty; other files are kept."""
        self.settle()
        for path in self._named(OURS) + self._named(UNFINISHED):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _named(self, pattern: re.Pattern[str]) -> list[Path]:
        entries = self.folder.iterdir() if self.folder.is_dir() else ()
        return [path for path in entries if pattern.fullmatch(path.name)]

    @contextmanager
    def _opened(self, index: int) -> Iterator[Any]:
        self.settle()
        path = self.path(index)
        if not path.is_file():
            raise RunError(f"no submap {index} in {self.folder}: {path.name} is missing; run it again")
        with open_tensors(path, "submap", arrays=True) as file:
            yield file
