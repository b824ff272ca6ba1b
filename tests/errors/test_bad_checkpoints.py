"""A damaged checkpoint is refused in one line, whatever is wrong with it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from sigmasplat.data.atlas import Atlas
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import GaussianField
from sigmasplat.data.poses import Place
from sigmasplat.data.relative_pose import UNKNOWN_HOP, Edges, RelativePose
from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError, SigmaSplatError
from sigmasplat.plugins.outputs.floorplan.floor_plan import floor_plan
from sigmasplat.plugins.presets.shared_by_papers import BASE
from sigmasplat.run_folder.runs import RunFolder
from sigmasplat.system.slam import checkpoint_of

Tensors = dict[str, torch.Tensor]


def changed(name: str, change: Callable[[torch.Tensor], torch.Tensor]) -> Callable[[Tensors], Tensors]:
    return lambda tensors: tensors | {name: change(tensors[name])}


DAMAGES = {
    "0-d": changed("keyframe_submap", lambda t: t[0].clone()),
    "keyframe that does not exist": changed("keyframes", lambda t: t + (1 << 40)),
    "negative submap": changed("frame_submap", lambda t: t - 1),
    "floats as numbers": changed("frame_keyframe", torch.Tensor.double),
    "fewer poses": changed("T_world_camera", lambda t: t[1:].clone()),
    "no number": changed("edge_T_a_b", lambda t: t.new_full((1, 4, 4), torch.nan)),
    "numbers as flags": changed("edge_is_loop", torch.Tensor.long),
    "compared keyframe of another submap": changed("edge_keyframes", lambda t: torch.tensor([[0, 2]])),
    "keyframe of another submap": changed("frame_keyframe", lambda t: t.clamp(min=1)),
    "last bit of a pose": changed("T_world_camera", lambda t: t.nextafter(t + 1)),
    "a tensor is missing": lambda tensors: {name: t for name, t in tensors.items() if name != "keyframes"},
}


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """Return a run with the path of three frames in two submaps, the errors of the path, and no map."""
    T = np.eye(4)
    atlas = Atlas()
    for submap, keyframe in ((0, 0), (0, 1), (1, 0)):
        atlas.places.append(Place(submap, keyframe, T))
    for submap, keyframes in enumerate((2, 1)):
        atlas.begin_submap(T if submap else None)
        for k in range(keyframes):
            atlas.set_keyframes([T] * (k + 1), UNKNOWN_HOP)
    edges = Edges()
    edges.append(RelativePose(0, 1, T, np.eye(6), kind="loop"))
    run = RunFolder.create(tmp_path / "run", BASE, "room")
    trajectory = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    run.write_checkpoint(checkpoint_of(GaussianField.empty(), trajectory, atlas, [0, 1, 2], edges), {})
    return run


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_tensor_is_refused(run: RunFolder, damage: str) -> None:
    assert run.read_checkpoint()[0]
    path = run.path / "checkpoint.safetensors"
    save_file(DAMAGES[damage](load_file(path)), path)
    with pytest.raises(RunError, match="is damaged: its checksum") as refusal:
        run.read_checkpoint()
    assert str(path) in str(refusal.value) and "run it again" in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_floor_plan_of_kilometres_is_refused_before_memory_is_taken() -> None:
    field = GaussianField.from_values(
        torch.tensor([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0]]),
        torch.full((2, 3), 0.5),
        torch.full((2, 3), 0.5),
        opacities=0.99,
    )  # fmt: skip
    poses = torch.eye(4).repeat(2, 1, 1).double().numpy()
    poses[1, 0, 3] = 1e7
    path, camera = Trajectory(torch.arange(2).double().numpy(), poses), Camera(64, 48, 60.0, 60.0, 32.0, 24.0)
    with pytest.raises(SigmaSplatError, match=r"too many cells of 0.05 m.*use larger cells"):
        floor_plan(field, path, camera)
