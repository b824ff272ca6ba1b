"""Valid archives are unpacked completely; malicious ones write nothing outside their folder and are stopped early."""

import tarfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from archives import entry, folder_content, tar_gz, zipped
from sigmasplat.plugins.download.downloader import ArchiveError, unpack
from sigmasplat.types import no_progress

FILES = {"rgb.txt": b"# colour\n", "rgb/1.png": bytes(range(256)) * 999, "rgb/2.png": b"", "a b/ö.txt": b"x"}
PLENTY = 2**24


def unpacked(content: bytes, name: str, folder: Path, most: int = PLENTY) -> dict[str, bytes]:
    """Unpack an archive to `folder`/inside; return its files."""
    folder.mkdir(exist_ok=True)
    archive = folder / name
    archive.write_bytes(content)
    unpack(archive, folder / "inside", most, no_progress)
    return folder_content(folder / "inside")


@pytest.mark.parametrize(("pack", "name"), [(tar_gz, "a.tgz"), (tar_gz, "a.TAR.GZ"), (zipped, "a.zip")])
def test_all_files_are_unpacked(pack: Callable[..., bytes], name: str, tmp_path: Path) -> None:
    assert unpacked(pack(FILES), name, tmp_path) == FILES


@pytest.mark.parametrize(("pack", "name"), [(tar_gz, "a.tgz"), (zipped, "a.zip")])
def test_progress_reaches_the_end(pack: Callable[..., bytes], name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(pack(FILES))
    calls: list[tuple[int, int]] = []
    unpack(tmp_path / name, tmp_path / "inside", PLENTY, lambda *counts: calls.append(counts))
    assert calls[-1][0] == calls[-1][1] > 0 and calls == sorted(calls)
    assert calls.count(calls[-1]) == 1, "the end is reported once"


def test_desktop_files_are_left_out(tmp_path: Path) -> None:
    litter = {"Thumbs.db": b"1", "__MACOSX/rgb/1.png": b"2", "rgb/._1.png": b"3", "rgb/.DS_Store": b"4"}
    for i, (pack, name) in enumerate(((tar_gz, "a.tgz"), (zipped, "a.zip"))):
        assert unpacked(pack(FILES | litter), name, tmp_path / str(i)) == FILES


def test_windows_separators_and_dots_are_supported(tmp_path: Path) -> None:
    assert unpacked(zipped({"seq\\1.txt": b"1", "./seq//2.txt": b"2"}), "a.zip", tmp_path) == {
        "seq/1.txt": b"1",
        "seq/2.txt": b"2",
    }


HOSTILE_NAMES = ["../evil", "a/../../evil", "/tmp/evil", "..\\evil", "C:\\evil", "\\\\host\\evil", ".."]


@pytest.mark.parametrize("name", HOSTILE_NAMES)
@pytest.mark.parametrize(("pack", "archive"), [(tar_gz, "a.tgz"), (zipped, "a.zip")])
def test_names_that_leave_the_folder_are_refused(
    pack: Callable[..., bytes], archive: str, name: str, tmp_path: Path
) -> None:
    with pytest.raises(ArchiveError, match="leaves the folder"):
        unpacked(pack({"good": b"1", name: b"evil"}), archive, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {archive, "inside"}
    assert "evil" not in str(list((tmp_path / "inside").rglob("*")))


@given(parts=st.lists(st.sampled_from(["..", ".", "", "a", "/", "\\", "b\\..\\..", "C:", "~"]), min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_no_name_writes_outside_the_folder(parts: list[str], tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("names")
    content = tar_gz({"/".join(parts) + "x": b"1"})
    with suppress(ArchiveError):
        unpacked(content, "a.tgz", folder / "here")
    assert set(folder_content(folder)) - {"here/a.tgz"} == set(folder_content(folder / "here/inside", "here/inside/"))


@pytest.mark.parametrize(
    "strange",
    [
        entry(tarfile.SYMTYPE, leads_to="/etc/passwd"),
        entry(tarfile.SYMTYPE, leads_to="../.."),
        entry(tarfile.LNKTYPE, leads_to="/etc/passwd"),
        entry(tarfile.LNKTYPE, leads_to="rgb.txt"),
        entry(tarfile.CHRTYPE),
        entry(tarfile.BLKTYPE),
        entry(tarfile.FIFOTYPE),
    ],
    ids=["symlink", "symlink up", "hard link", "hard link inside", "character device", "block device", "pipe"],
)
def test_only_files_and_folders_are_created(strange: tarfile.TarInfo, tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="'odd', which is not a plain file or folder"):
        unpacked(tar_gz(FILES, strange), "a.tgz", tmp_path)
    assert not (tmp_path / "inside/odd").exists() and not (tmp_path / "inside/odd").is_symlink()


def test_a_link_in_a_zip_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="'way', which is not a plain file or folder"):
        unpacked(zipped(FILES | {"way/evil": b"1"}, links={"way": "/tmp"}), "a.zip", tmp_path)
    assert folder_content(tmp_path / "inside") == {}


@pytest.mark.parametrize(("pack", "name"), [(tar_gz, "bomb.tgz"), (zipped, "bomb.zip")])
def test_archive_bombs_are_stopped(pack: Callable[..., bytes], name: str, tmp_path: Path) -> None:
    bomb = pack({"zeros": bytes(2**23)})
    assert len(bomb) < 2**14
    with pytest.raises(ArchiveError, match="more bytes than expected"):
        unpacked(bomb, name, tmp_path, most=2**20)
    assert sum(map(len, folder_content(tmp_path / "inside").values())) <= 2**20


def test_a_zip_with_wrong_sizes_is_damaged(tmp_path: Path) -> None:
    honest = zipped({"zeros": bytes(50_000)})
    lying = honest.replace((50_000).to_bytes(4, "little"), (5).to_bytes(4, "little"))
    assert lying != honest
    with pytest.raises(ArchiveError, match="is damaged"):
        unpacked(lying, "a.zip", tmp_path)


@pytest.mark.parametrize(("pack", "name"), [(tar_gz, "a.tgz"), (zipped, "a.zip")])
def test_a_truncated_archive_is_damaged(pack: Callable[..., bytes], name: str, tmp_path: Path) -> None:
    for share in [0.0, 0.01, 0.5, 0.9, 0.999]:
        whole = pack(FILES | {"noise": bytes(i * i % 251 for i in range(9000))})
        with pytest.raises(ArchiveError, match="is damaged"):
            unpacked(whole[: int(share * len(whole))], name, tmp_path / str(share))


@pytest.mark.parametrize(("pack", "name"), [(tar_gz, "a.tgz"), (zipped, "a.zip")])
def test_a_flipped_bit_in_the_content_is_damage(pack: Callable[..., bytes], name: str, tmp_path: Path) -> None:
    content = bytearray(pack({"noise": bytes(i * i * i % 251 for i in range(9000))}))
    content[len(content) // 3] ^= 4
    with pytest.raises(ArchiveError):
        unpacked(bytes(content), name, tmp_path)


def test_damage_after_the_last_file_is_noticed(tmp_path: Path) -> None:
    content = tar_gz(FILES)
    with pytest.raises(ArchiveError, match="CRC"):
        unpacked(content[:-8] + bytes(4) + content[-4:], "a.tgz", tmp_path)


def test_other_files_are_not_archives(tmp_path: Path) -> None:
    for name in ("page.tgz", "page.zip"):
        with pytest.raises(ArchiveError, match="is damaged"):
            unpacked(b"<html>login</html>" * 99, name, tmp_path / name[5:])
