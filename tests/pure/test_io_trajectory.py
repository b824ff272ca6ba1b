"""TUM text: paths are read back unchanged, and errors name the line."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sigmasplat.data.trajectory import Trajectory
from sigmasplat.errors import RunError, SourceError
from sigmasplat.input.lists import read_poses
from sigmasplat.run_folder.trajectory import write_trajectory


def some_path(n: int = 40) -> Trajectory:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.random(n, random_state=1).as_matrix()
    poses[:, :3, 3] = np.random.default_rng(1).normal(0, 3, (n, 3))
    return Trajectory(1305031102.175304 + np.arange(n) / 30.0, poses)


def test_round_trip_keeps_microseconds_and_nanometres(tmp_path: Path) -> None:
    path = some_path()
    write_trajectory(tmp_path / "trajectory.txt", path)
    back = read_poses(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(back.timestamps_s, path.timestamps_s, rtol=0, atol=1e-6)
    np.testing.assert_allclose(back.T_world_camera, path.T_world_camera, rtol=0, atol=1e-9)


def test_columns_are_those_of_tum(tmp_path: Path) -> None:
    """A rotation by 90° about z: qx qy qz qw = 0 0 √½ √½, w last."""
    T = np.array([[0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 0.25], [0, 0, 0, 1.0]])
    write_trajectory(tmp_path / "t.txt", Trajectory(np.array([2.5]), T[None]))
    (line,) = [line for line in (tmp_path / "t.txt").read_text().splitlines() if not line.startswith("#")]
    root = np.sqrt(0.5)
    assert [float(word) for word in line.split()] == pytest.approx([2.5, 1.5, -2, 0.25, 0, 0, root, root])
    (tmp_path / "tum.txt").write_text("# timestamp tx ty tz\n\n2.5 1.5 -2 0.25 0 0 0.7071 0.7071 # later\n")
    np.testing.assert_allclose(read_poses(tmp_path / "tum.txt").T_world_camera[0], T, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("1 2 3", "bad.txt:3: expected 't tx ty tz qx qy qz qw', found 3"),
        ("1 0 0 0 0 0 0 1 9", "bad.txt:3: expected 't tx ty tz qx qy qz qw', found 9"),
        ("1 0 0 x 0 0 0 1", "bad.txt:3: expected numbers"),
        ("1 0 nan 0 0 0 0 1", "bad.txt:3: not finite"),
        ("1 0 0 inf 0 0 0 1", "bad.txt:3: not finite"),
        ("1 0 0 0 0 0 0 0", "bad.txt:3: the pose is not rigid: its quaternion has length 0"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, complaint: str) -> None:
    (tmp_path / "bad.txt").write_text(f"# head\n0 0 0 0 0 0 0 1\n{line}\n2 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match=complaint):
        read_poses(tmp_path / "bad.txt")


def test_missing_empty_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="cannot read"):
        read_poses(tmp_path / "no.txt")
    (tmp_path / "empty.txt").write_text("# nothing\n")
    with pytest.raises(SourceError, match="holds no poses"):
        read_poses(tmp_path / "empty.txt")
    assert len(read_poses(tmp_path / "empty.txt", may_be_empty=True)) == 0
    (tmp_path / "image.txt").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(SourceError, match="cannot read"):
        read_poses(tmp_path / "image.txt")
    with pytest.raises(RunError, match="cannot write"):
        write_trajectory(tmp_path / "no" / "t.txt", some_path(2))


def test_a_pose_beyond_a_million_kilometres_is_refused(tmp_path: Path) -> None:
    for text in ("1 0 6.4e6 0 0 0 0 1\n2 0 0 -1e10 0 0 0 1\n", "2 0 0 1e308 0 0 0 1\n"):
        (tmp_path / "t.txt").write_text(text)
        with pytest.raises(SourceError, match=r"pose at t=2\.0 s is farther than 1e\+09 m"):
            read_poses(tmp_path / "t.txt")
