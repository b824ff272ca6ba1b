"""Page finished submaps to disk, one file each, read again in parts."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from sigmasplat.errors import RunError
from sigmasplat.io.atomic import replacing
from sigmasplat.model.camera import Camera
from sigmasplat.model.field import EXTRAS, GaussianField, Rows
from sigmasplat.model.submap import Picture, Submap, refuse_misfit

PATTERN = "submap-*.safetensors"


class DiskStore:
    """Submaps as files in a folder (`model.submap.SubmapStore`): splats, keyframe poses, and the pictures beside them.

    Pictures are read one at a time, so that memory does not grow with what is kept.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __len__(self) -> int:
        return len(list(self.folder.glob(PATTERN)))

    def path(self, index: int) -> Path:
        """Return where a submap is kept."""
        return self.folder / f"submap-{index:05d}.safetensors"

    def save(self, submap: Submap, pictures: list[Picture]) -> None:
        """Write a submap. Raises SigmaSplatError if it does not fit, RunError if it cannot be written."""
        refuse_misfit(submap, pictures, len(self))
        tensors = {
            "params": submap.field.params,
            "T_submap_camera": torch.from_numpy(np.ascontiguousarray(submap.T_submap_camera)),
            "frames": torch.tensor(submap.frames, dtype=torch.int64),
            **{f"extra.{name}": extra.params for name, extra in submap.field.extras.items()},
            "colors": torch.from_numpy(np.stack([picture.color for picture in pictures])),
            "depths_m": torch.from_numpy(np.stack([picture.depth_m for picture in pictures])),
        }
        own = {name: tensor.detach().contiguous() for name, tensor in tensors.items()}
        text = {"index": str(submap.index), "camera": json.dumps(asdict(submap.camera))}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(self.path(submap.index)) as temporary:
                save_file(own, temporary, text)
        except OSError as problem:
            raise RunError(f"cannot write {self.path(submap.index)}: {problem.strerror or problem}") from problem

    def load(self, index: int) -> Submap:
        """Read a submap without its pictures. Raises RunError if it is missing or damaged."""
        with self._opened(index) as file:
            extras = {n: Rows(file.get_tensor(f"extra.{n}")) for n in EXTRAS if f"extra.{n}" in file.keys()}  # noqa: SIM118
            return Submap(
                index,
                GaussianField(file.get_tensor("params"), extras=extras),
                tuple(file.get_tensor("frames").tolist()),
                file.get_tensor("T_submap_camera").numpy(),
                Camera(**json.loads(file.metadata()["camera"])),
            )

    def picture(self, index: int, keyframe: int) -> Picture:
        """Read what one keyframe saw. Raises RunError if the submap is missing or damaged."""
        with self._opened(index) as file:
            color, depth_m = (file.get_slice(name)[keyframe] for name in ("colors", "depths_m"))
            return Picture(color.numpy(), depth_m.numpy())

    def _opened(self, index: int) -> Any:
        path = self.path(index)
        if not path.is_file():
            raise RunError(f"no submap {index} in {self.folder}: there is no {path.name}; run it again")
        try:
            return safe_open(path, "pt")
        except (SafetensorError, OSError) as problem:
            raise RunError(f"submap {path} is damaged: {problem}") from problem
