"""Submaps on disk: they are read back bit for bit and in parts, and damage is reported in one line."""

import errno
import gc
import json
import os
import threading
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch

from sigmasplat.data import se3
from sigmasplat.data.camera import Camera
from sigmasplat.data.field import ATTRIBUTES, GaussianField, Rows
from sigmasplat.data.frame import Detail, Frame
from sigmasplat.data.submap import MemoryStore, Picture, Submap, SubmapStore
from sigmasplat.errors import RunError
from sigmasplat.files import tensors
from sigmasplat.files.tensors import open_tensors, write_tensors
from sigmasplat.run.resume import state_of
from sigmasplat.run_folder.submaps import DiskStore
from sigmasplat.system.slam import Slam
from sigmasplat.types import completed

CAMERA = Camera(8, 6, 7.25, 7.5, 3.5 + 1 / 3, 2.5)


def some_submap(index: int = 0, keyframes: int = 3, attributes: tuple[str, ...] = ()) -> tuple[Submap, list[Picture]]:
    """Return a submap of random values, and different images for its keyframes."""
    rng = np.random.default_rng(index)
    torch.manual_seed(index)
    field = GaussianField(
        torch.randn(5, 17), attributes={name: Rows(torch.randn(5, ATTRIBUTES[name])) for name in attributes}
    )
    poses = np.stack([se3.exp(rng.normal(size=6)) for _ in range(keyframes)])
    pictures = [
        Picture(rng.integers(0, 256, (6, 8, 3), dtype=np.uint8), rng.uniform(0, 4, (6, 8)).astype(np.float32))
        for _ in range(keyframes)
    ]
    return Submap(index, field, tuple(range(10 * index, 10 * index + keyframes)), poses, CAMERA), pictures


@pytest.fixture
def store(tmp_path: Path) -> DiskStore:
    return DiskStore(tmp_path / "run" / "submaps")


def assert_same(found: Submap, wanted: Submap) -> None:
    assert (found.index, found.frames, found.camera) == (wanted.index, wanted.frames, wanted.camera)
    assert found.T_submap_camera.dtype == np.float64 and np.array_equal(found.T_submap_camera, wanted.T_submap_camera)
    assert found.field.params.dtype == torch.float32 and torch.equal(found.field.params, wanted.field.params)
    assert set(found.field.attributes) == set(wanted.field.attributes)
    for name, attribute in wanted.field.attributes.items():
        assert torch.equal(found.field.attributes[name].params, attribute.params)


@pytest.mark.parametrize("attributes", [(), tuple(ATTRIBUTES)], ids=["plain", "all attributes"])
def test_a_submap_is_read_back_bit_for_bit(store: DiskStore, attributes: tuple[str, ...]) -> None:
    submap, pictures = some_submap(attributes=attributes)
    store.save(submap, pictures)
    assert_same(store.load(0), submap)
    for k, picture in enumerate(pictures):
        back = store.picture(0, k)
        assert back.color.dtype == np.uint8 and np.array_equal(back.color, picture.color)
        assert back.depth_m.dtype == np.float32 and np.array_equal(back.depth_m, picture.depth_m)


def detailed(pictures: list[Picture], camera: Camera) -> list[Picture]:
    """Return the pictures with gray images of their own size."""
    rng = np.random.default_rng(7)
    gray = [rng.integers(0, 256, (camera.height, camera.width), dtype=np.uint8) for _ in pictures]
    return [replace(picture, detail=Detail(g, camera)) for picture, g in zip(pictures, gray, strict=True)]


def test_the_images_for_features_are_read_back_with_their_own_camera(store: DiskStore) -> None:
    submap, pictures = some_submap()
    large = Camera(16, 12, 14.5, 15.0, 7.5 + 1 / 3, 5.5)
    wanted = detailed(pictures, large)
    store.save(submap, wanted)
    for k, picture in enumerate(wanted):
        back = store.picture(0, k)
        assert back.detail is not None and picture.detail is not None and back.detail.camera == large
        assert back.detail.gray.dtype == np.uint8 and np.array_equal(back.detail.gray, picture.detail.gray)
        assert np.array_equal(back.color, picture.color) and np.array_equal(back.depth_m, picture.depth_m)


def test_submaps_of_older_releases_have_no_images_for_features(store: DiskStore) -> None:
    """A file without them, and a submap of which only some keyframes have one, are read without."""
    submap, pictures = some_submap()
    store.save(submap, pictures)
    with open_tensors(store.path(0), "submap") as file:
        assert not any("detail" in name for name in [*file.keys(), *(file.metadata() or {})])
    second, others = some_submap(1)
    store.save(second, [*detailed(others[:1], CAMERA), *others[1:]])
    assert store.picture(0, 1).detail is None
    assert store.picture(1, 0).detail is None and np.array_equal(store.picture(1, 0).color, others[0].color)


def test_an_empty_submap_and_nan_are_read_back(store: DiskStore) -> None:
    submap, pictures = some_submap(keyframes=1)
    params = torch.zeros(0, 17)
    store.save(Submap(0, GaussianField(params), submap.frames, submap.T_submap_camera, CAMERA), pictures)
    assert len(store.load(0).field) == 0
    second, pictures = some_submap(1)
    second.field.params[0, 0] = float("nan")
    store.save(second, pictures)
    assert torch.equal(store.load(1).field.params.isnan(), second.field.params.isnan())


def test_disk_and_memory_stores_behave_alike(store: DiskStore) -> None:
    kept: list[SubmapStore] = [store, MemoryStore()]
    for index in range(3):
        for where in kept:
            where.save(*some_submap(index, keyframes=index + 1))
    assert [len(where) for where in kept] == [3, 3]
    for index in (2, 0, 1):
        assert_same(kept[0].load(index), kept[1].load(index))
        assert np.array_equal(kept[0].picture(index, index).color, kept[1].picture(index, index).color)


def test_probe_views_are_read_back_from_both_stores(store: DiskStore) -> None:
    submap, pictures = some_submap(0)
    _, probes = some_submap(1, keyframes=2)
    poses = np.stack([se3.exp(np.full(6, 0.1 * k)) for k in range(2)])
    submap = replace(submap, probe_frames=(4, 7), T_submap_probe=poses)
    for where in (store, MemoryStore()):
        where.save(submap, pictures, probes)
        found = where.load(0)
        assert found.probe_frames == (4, 7) and np.array_equal(found.T_submap_probe, poses)
        for k, probe in enumerate(probes):
            assert np.array_equal(where.probe(0, k).color, probe.color)
            assert np.array_equal(where.probe(0, k).depth_m, probe.depth_m)
        with pytest.raises(AssertionError, match="with all images"):
            where.save(replace(submap, index=1), pictures, probes[:1])


def test_memory_does_not_grow_with_the_number_of_submaps_written_and_read(store: DiskStore) -> None:
    """Every submap has another number of splats: one type per size would be kept."""

    def traced(first: int, last: int) -> int:
        tracemalloc.start()
        for index in range(first, last):
            submap, pictures = some_submap(index)
            store.save(replace(submap, field=GaussianField(torch.zeros(100 + index, 17))), pictures)
            for k in range(3):
                store.picture(index, k)
            assert len(store.load(index).field) == 100 + index
        gc.collect()
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return kept

    traced(0, 20)
    assert traced(20, 120) < 100 * 1000, "bytes per submap; one type takes 5000"


def test_another_store_of_the_same_folder_has_the_same_submaps(store: DiskStore) -> None:
    assert len(store) == 0 and not store.folder.exists(), "the folder is created with the first submap"
    store.save(*some_submap(0))
    assert len(DiskStore(store.folder)) == 1
    assert_same(DiskStore(store.folder).load(0), some_submap(0)[0])
    other = DiskStore(store.folder)
    for count in (2, 3):
        store.save(*some_submap(count - 1))
        assert len(other) == len(store) == count, "another process may write"
    other.truncate(1)
    assert len(other) == len(store) == 1


def test_loaded_submaps_do_not_share_memory(store: DiskStore) -> None:
    submap, pictures = some_submap()
    store.save(submap, pictures)
    first = store.load(0)
    first.field.params.zero_()
    first.T_submap_camera[:] = 0.0
    store.picture(0, 0).color[:] = 0
    assert_same(store.load(0), submap)
    assert np.array_equal(store.picture(0, 0).color, pictures[0].color)


def test_splats_that_are_views_of_one_tensor_can_be_saved(store: DiskStore) -> None:
    base, (submap, pictures) = torch.randn(9, 62), some_submap()
    field = GaussianField(base[2:7, :17], attributes={"harmonics": Rows(base[2:7, 17:])})
    store.save(Submap(0, field, submap.frames, submap.T_submap_camera[:, :, :], CAMERA), pictures)
    assert torch.equal(store.load(0).field.params, base[2:7, :17])
    assert torch.equal(store.load(0).field.attributes["harmonics"].params, base[2:7, 17:])


@pytest.mark.parametrize("frozen", [True, False])
def test_read_only_poses_can_be_saved(store: DiskStore, frozen: bool, recwarn: pytest.WarningsRecorder) -> None:
    submap, pictures = some_submap()
    submap.T_submap_camera.flags.writeable = not frozen
    store.save(submap, pictures)
    assert_same(store.load(0), submap)
    assert not recwarn.list


def test_images_are_read_one_by_one(store: DiskStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading images reads only their rows of the file; reading a submap reads no image."""
    store.save(*some_submap())
    asked: list[tuple[str, object]] = []
    real = tensors.safe_open

    class Watched:
        def __init__(self, *arguments: object) -> None:
            self.file = real(*arguments)

        def __enter__(self) -> "Watched":
            self.file.__enter__()
            return self

        def __exit__(self, *problem: object) -> None:
            self.file.__exit__(*problem)

        def get_tensor(self, name: str) -> torch.Tensor:
            asked.append((name, "whole"))
            return self.file.get_tensor(name)

        def get_slice(self, name: str) -> object:
            part = self.file.get_slice(name)

            class Part:
                def __getitem__(self, row: int) -> torch.Tensor:
                    asked.append((name, row))
                    return part[row]

            return Part()

        def __getattr__(self, name: str) -> object:
            return getattr(self.file, name)

    monkeypatch.setattr(tensors, "safe_open", Watched)
    store.picture(0, 1)
    assert asked == [("colors", 1), ("depths_m", 1)]
    asked.clear()
    store.load(0)
    assert {name for name, _ in asked} == {"params", "frames", "T_submap_camera"}


def test_submaps_are_saved_in_order(store: DiskStore) -> None:
    with pytest.raises(AssertionError, match="in their order"):
        store.save(*some_submap(1))
    store.save(*some_submap(0))
    with pytest.raises(AssertionError, match="in their order"):
        store.save(*some_submap(0))
    submap, pictures = some_submap(1)
    with pytest.raises(AssertionError, match="with all images"):
        store.save(submap, pictures[:2])
    assert len(store) == 1 and not list(store.folder.glob(".*"))


def test_a_missing_submap_is_named(store: DiskStore) -> None:
    for read in (lambda: store.load(3), lambda: store.picture(3, 0)):
        with pytest.raises(RunError, match=r"no submap 3 in .*submaps: submap-00003\.safetensors is missing"):
            read()


def refused(store: DiskStore) -> str:
    with pytest.raises(RunError, match=r"submap .*submap-00000\.safetensors is damaged: ") as caught:
        store.load(0)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("keep", [0, 5, 200, -1], ids=["empty", "five bytes", "half the head", "a byte short"])
def test_a_file_cut_short_is_refused(store: DiskStore, keep: int) -> None:
    store.save(*some_submap())
    path = store.path(0)
    path.write_bytes(path.read_bytes()[:keep])
    refused(store)
    with pytest.raises(RunError, match="is damaged"):
        store.picture(0, 0)


def test_an_incomplete_file_is_refused(store: DiskStore) -> None:
    """Missing tensors, missing metadata, damaged metadata, and a camera with other fields."""
    store.save(*some_submap())
    with tensors.open_tensors(store.path(0), "submap") as file:
        everything = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    for left_out, text in (
        ("params", {"camera": json.dumps(vars(CAMERA))}),
        ("frames", {"camera": json.dumps(vars(CAMERA))}),
        ("", None),
        ("", {"camera": "{"}),
        ("", {"camera": '{"width": 8, "lens": "fisheye"}'}),
    ):
        some = {name: tensor for name, tensor in everything.items() if name != left_out}
        safetensors.torch.save_file(some, store.path(0), text)
        assert left_out in refused(store)


def test_a_missing_keyframe_is_refused(store: DiskStore) -> None:
    store.save(*some_submap(keyframes=2))
    with pytest.raises(RunError, match="is damaged"):
        store.picture(0, 2)


def test_an_unwritable_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "submaps").write_text("a file")
    with pytest.raises(RunError, match=r"cannot write .*submaps"):
        DiskStore(tmp_path / "submaps").save(*some_submap())


def test_an_incomplete_submap_does_not_count(store: DiskStore, monkeypatch: pytest.MonkeyPatch) -> None:
    store.save(*some_submap(0))

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(tensors, "save_file", stop)
    with pytest.raises(KeyboardInterrupt):
        store.save(*some_submap(1))
    assert [path.name for path in store.folder.iterdir()] == ["submap-00000.safetensors"] and len(store) == 1


def test_files_have_the_usual_permissions(store: DiskStore, tmp_path: Path) -> None:
    store.save(*some_submap())
    (tmp_path / "other").write_text("")
    assert store.path(0).stat().st_mode == (tmp_path / "other").stat().st_mode


def test_clearing_removes_only_submaps(store: DiskStore) -> None:
    store.clear()
    store.save(*some_submap(0))
    (store.folder / ".submap-00001.safetensors.part").write_text("")
    (store.folder / "submap-best.safetensors").write_text("mine")
    store.clear()
    assert [path.name for path in store.folder.iterdir()] == ["submap-best.safetensors"] and len(store) == 0
    (store.folder / "submap-best.safetensors").unlink()
    store.clear()
    assert not store.folder.exists()


def test_the_same_submap_makes_the_same_bytes(tmp_path: Path) -> None:
    submap, pictures = some_submap()
    for name in "abcdefgh":
        DiskStore(tmp_path / name).save(submap, pictures)
    files = [next((tmp_path / name).iterdir()).read_bytes() for name in "abcdefgh"]
    assert len(set(files)) == 1


def test_tensors_and_text_are_read_back_whatever_the_text(tmp_path: Path) -> None:
    text = {f"key {i}": f'"ü" \\ line\n{i}' for i in range(9)}
    made = set[bytes]()
    for name in "abcd":
        write_tensors(tmp_path / name, {"x": torch.arange(3.0)}, text)
        made.add((tmp_path / name).read_bytes())
    assert len(made) == 1
    with open_tensors(tmp_path / "a", "file") as file:
        assert file.metadata() == text and file.get_tensor("x").tolist() == [0.0, 1.0, 2.0]


class SlowDisk:
    """Files of tensors are not written before `free` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free, real = threading.Event(), tensors.save_file

        def late(*arguments: Any) -> None:
            assert self.free.wait(30)
            real(*arguments)

        monkeypatch.setattr(tensors, "save_file", late)


def test_in_the_background_a_submap_counts_at_once_and_reading_waits_for_it(
    store: DiskStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, background = SlowDisk(monkeypatch), store.in_background()
    submap, pictures = some_submap(0)
    background.save(submap, pictures)
    assert len(background) == 1 and len(store) == 0
    threading.Timer(0.1, disk.free.set).start()
    assert_same(background.load(0), submap)
    assert len(store) == 1 and np.array_equal(store.picture(0, 1).color, pictures[1].color)
    background.save(*some_submap(1))
    background.settle()
    assert len(store) == len(background) == 2
    background.truncate(1)
    assert len(store) == len(background) == 1


def test_a_full_disk_in_the_background_is_reported_by_whatever_comes_next(
    store: DiskStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_tensors: object, path: Path, _text: object) -> None:
        path.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    background = store.in_background()
    background.save(*some_submap(0))
    background.settle()
    monkeypatch.setattr(tensors, "save_file", full)
    background.save(*some_submap(1))
    for next_one in (background.settle, lambda: background.load(0), lambda: background.save(*some_submap(2))):
        with pytest.raises(RunError, match=r"cannot write .*submap-00001.*No space left") as caught:
            next_one()
        assert "\n" not in str(caught.value)
    assert [path.name for path in store.folder.iterdir()] == ["submap-00000.safetensors"]


def test_a_state_waits_for_its_submaps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = DiskStore(tmp_path)
    slam = Slam("sigma", store.in_background())
    disk = SlowDisk(monkeypatch)
    camera = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    slam.step(Frame(0, 0.0, np.full((24, 32, 3), 0.5, np.float32), np.full((24, 32), 2.0, np.float32), camera))
    completed(slam.finish_submap())
    threading.Timer(0.1, disk.free.set).start()
    assert len(store) == 0 and state_of(slam)["submaps"] == 1 and len(store) == 1
