"""A recording is downloaded completely or not at all, and only once; every address of the catalogue is valid."""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import file_server as acts
from archives import folder_content, tar_gz, zipped
from command_line import exit_code
from file_server import FileServer, serving
from sigmasplat.errors import DownloadError
from sigmasplat.graph.closer import NETVLAD
from sigmasplat.plugins.download import (
    describe_recordings,
    describe_sets,
    download_recording,
    fetch as fetching,
    find_recording,
)
from sigmasplat.plugins.download.catalogue import SETS, PublicRecording, PublicSet, RemoteFile
from sigmasplat.plugins.download.downloader import MARKER

FILES = {"rgb.txt": b"# colour\n", "rgb/1.png": bytes(i * i % 251 for i in range(5000))}
PUBLIC = [entry for entry in SETS.values() if entry.recordings]


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[FileServer]:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetching, "ATTEMPTS", 2)
    monkeypatch.setattr(fetching, "WAIT_S", 0.001)
    with serving() as server:
        server.files["/desk.tgz"] = tar_gz({f"desk/{name}": content for name, content in FILES.items()})
        yield server


def public_set(server: FileServer, *archives: RemoteFile, start: str = "") -> PublicSet:
    """Return a data set with one recording, `desk`; by default it is /desk.tgz on the server."""
    made = archives or (RemoteFile(server.url("/desk.tgz")),)
    return PublicSet("Test", "http://page", "free", "test", {"desk": PublicRecording("desk", made, start)})


def downloaded(public: PublicSet, out: Path, **options: bool) -> dict[str, bytes]:
    """Download `desk`; return its files without the marker."""
    folder = download_recording(public, "desk", out, lambda *counts: None, **options)
    assert folder == out / "test" / "desk"
    files = folder_content(folder)
    assert json.loads(files.pop(MARKER))["recording"] == "desk"
    return files


def test_a_recording_is_downloaded_and_unpacked_without_its_outer_folder(server: FileServer, tmp_path: Path) -> None:
    assert downloaded(public_set(server), tmp_path) == FILES
    assert sorted(path.name for path in (tmp_path / "test").iterdir()) == ["desk"]


def test_an_existing_recording_is_not_downloaded_again(server: FileServer, tmp_path: Path) -> None:
    downloaded(public_set(server), tmp_path)
    requests = list(server.ranges)
    assert downloaded(public_set(server), tmp_path) == FILES
    assert server.ranges == requests


def test_licence_and_size_are_printed_first(server: FileServer, tmp_path: Path) -> None:
    said: list[str] = []
    size = len(server.files["/desk.tgz"])
    public = public_set(server, RemoteFile(server.url("/desk.tgz"), size))
    download_recording(public, "desk", tmp_path, lambda *counts: said.append("bytes"), said.append)
    assert said[0].startswith("Test desk: ") and said[0].endswith(f"→ {tmp_path / 'test' / 'desk'}")
    assert said[1].startswith("terms: free (http://page)") and said[2] == "bytes"


def test_overwrite_replaces_the_whole_folder(server: FileServer, tmp_path: Path) -> None:
    downloaded(public_set(server), tmp_path)
    (tmp_path / "test/desk/left over").write_text("")
    assert downloaded(public_set(server), tmp_path, overwrite=True) == FILES


def test_several_archives_form_one_folder(server: FileServer, tmp_path: Path) -> None:
    server.files |= {"/c.zip": zipped({"1.jpg": b"c", "2.jpg": b"d"}), "/d.zip": zipped({"w/1.png": b"d"})}
    server.files["/path.txt"] = b"0 0 0\n"
    parts = (
        RemoteFile(server.url("/c.zip"), into="color"),
        RemoteFile(server.url("/d.zip"), into="depth"),
        RemoteFile(server.url("/path.txt"), into="trajectory.log"),
    )
    assert downloaded(public_set(server, *parts, start="color"), tmp_path) == {
        "color/1.jpg": b"c",
        "color/2.jpg": b"d",
        "depth/1.png": b"d",
        "trajectory.log": b"0 0 0\n",
    }


def test_nested_archives_are_unpacked(server: FileServer, tmp_path: Path) -> None:
    inner = zipped({"seq-01/frame.png": FILES["rgb/1.png"], "seq-01/Thumbs.db": b"x"})
    server.files["/desk.zip"] = zipped({"desk/seq-01.zip": inner, "desk/TestSplit.txt": b"1"})
    public = public_set(server, RemoteFile(server.url("/desk.zip"), nested=True), start="seq-01")
    assert downloaded(public, tmp_path) == {"seq-01/frame.png": FILES["rgb/1.png"], "TestSplit.txt": b"1"}


def checksum(algorithm: str, content: bytes) -> str:
    return f"{algorithm}:{hashlib.new(algorithm, content).hexdigest()}"


def test_weights_of_netvlad_are_checked_and_the_command_that_uses_them_is_printed(
    server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    recording = SETS["netvlad"].recordings[""]
    (published,) = recording.archives
    file = replace(published, url=server.url("/Pitts30K_struct.mat"))

    def offer(file: RemoteFile) -> None:
        offered = {"": replace(recording, archives=(file,))}
        monkeypatch.setitem(SETS, "netvlad", replace(SETS["netvlad"], recordings=offered))

    offer(file)
    server.files["/Pitts30K_struct.mat"] = b"not these"
    assert exit_code("download", "netvlad") == 2
    said = capsys.readouterr().err
    assert "its checksum is sha256:" in said and f"not {published.checksum}" in said and not folder_content(tmp_path)
    offer(replace(file, checksum=checksum("sha256", b"not these")))
    assert exit_code("download", "netvlad") == 0
    used = NETVLAD.rpartition("loops.weights=")[2]
    assert (tmp_path / used).read_bytes() == b"not these" and f"loops.weights={used}" in capsys.readouterr().out


@pytest.mark.parametrize("algorithm", ["sha256", "md5"])
def test_a_published_checksum_is_verified(algorithm: str, server: FileServer, tmp_path: Path) -> None:
    content = server.files["/desk.tgz"]
    archive = RemoteFile(server.url("/desk.tgz"), len(content), checksum(algorithm, content))
    server.files["/desk.tgz"] = content[:99] + bytes([content[99] ^ 1]) + content[100:]
    with pytest.raises(DownloadError, match=rf"was damaged and has been removed; its checksum is {algorithm}:\w+, not"):
        downloaded(public_set(server, archive), tmp_path)
    assert folder_content(tmp_path) == {}
    server.files["/desk.tgz"] = content
    assert downloaded(public_set(server, archive), tmp_path) == FILES


def test_a_partial_download_keeps_its_folder(server: FileServer, tmp_path: Path) -> None:
    server.files["/half.tgz"] = server.files["/desk.tgz"]
    both = public_set(server, RemoteFile(server.url("/half.tgz")), RemoteFile(server.url("/gone.tgz")))
    with pytest.raises(DownloadError, match="is not available"):
        downloaded(both, tmp_path)
    assert (tmp_path / "test/half.tgz").read_bytes() == server.files["/desk.tgz"]


@pytest.mark.parametrize("there", ["folder", "file", "broken link"])
def test_a_foreign_folder_is_not_changed(there: str, server: FileServer, tmp_path: Path) -> None:
    target = tmp_path / "test/desk"
    target.parent.mkdir()
    {"folder": target.mkdir, "file": target.touch, "broken link": lambda: target.symlink_to("/no/such")}[there]()
    with pytest.raises(DownloadError, match="was not created by this command"):
        download_recording(public_set(server), "desk", tmp_path, lambda *counts: None, overwrite=True)
    assert server.ranges == [] and (target.exists() or target.is_symlink())


BAD = {"outside": tar_gz({"../evil": b"1"}), "cut": tar_gz(FILES)[:-900], "zip": zipped({"a": b""})}


@pytest.mark.parametrize("content", BAD.values(), ids=BAD)
def test_a_bad_archive_leaves_no_files(content: bytes, server: FileServer, tmp_path: Path) -> None:
    server.files["/desk.tgz"] = content
    with pytest.raises(DownloadError, match=r"desk.tgz has been removed, run it again"):
        downloaded(public_set(server), tmp_path)
    assert list((tmp_path / "test").iterdir()) == []


def test_too_many_bytes_are_refused(server: FileServer, tmp_path: Path) -> None:
    server.files["/bomb.tgz"] = tar_gz({"desk/zeros": bytes(2**22)})
    with pytest.raises(DownloadError, match="more bytes than expected"):
        downloaded(public_set(server, RemoteFile(server.url("/bomb.tgz"))), tmp_path)


def test_an_unexpected_layout_is_refused(server: FileServer, tmp_path: Path) -> None:
    with pytest.raises(DownloadError, match="does not hold room0; the layout of the data set has changed"):
        downloaded(public_set(server, start="room0"), tmp_path)
    assert not (tmp_path / "test/desk").exists()


def test_disk_space_is_checked_first(server: FileServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Disk:
        free = 2 * len(server.files["/desk.tgz"])

    monkeypatch.setattr("shutil.disk_usage", lambda folder: Disk)
    with pytest.raises(
        DownloadError, match=r"not enough disk space in .*needed, .* free; free some space, or give --out"
    ):
        downloaded(public_set(server), tmp_path)
    assert folder_content(tmp_path) == {}


def test_ctrl_c_during_unpacking_leaves_only_the_archive(server: FileServer, tmp_path: Path) -> None:
    def interrupt(title: str, done: int, total: int) -> None:
        if title.startswith("unpack"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        download_recording(public_set(server), "desk", tmp_path, interrupt)
    assert {path.name for path in (tmp_path / "test").iterdir()} == {"desk.tgz"}
    requests = list(server.ranges)
    assert downloaded(public_set(server), tmp_path) == FILES
    assert server.ranges == requests


def test_a_broken_download_is_resumed(server: FileServer, tmp_path: Path) -> None:
    server.acts = [acts.drop_after(80), acts.status(503), acts.status(503)]
    with pytest.raises(DownloadError, match="80 bytes are kept"):
        downloaded(public_set(server), tmp_path)
    assert downloaded(public_set(server), tmp_path) == FILES
    assert server.ranges[-1] == "bytes=80-"


def test_names_may_be_written_in_several_ways() -> None:
    for name in ("fr1/desk", "FR1/desk", "fr1_desk", "freiburg1_desk", "rgbd_dataset_freiburg1_desk", "fr1-desk"):
        assert find_recording("tum", name)[1] == "fr1/desk"
    assert find_recording("bonn", "rgbd_bonn_balloon2")[1] == "balloon2"
    assert find_recording("Replica") == (SETS["replica"], "")


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        (("tumm", ""), "no data set 'tumm' (did you mean tum?)"),
        (("kitchen", ""), "no data set 'kitchen'; there are 7scenes, bonn"),
        (("tum", "fr1/dsk"), "no recording 'fr1/dsk' in tum (did you mean fr1/desk"),
        (("7scenes", ""), "give a recording of 7scenes; there are chess, fire"),
        (("replica", "room0"), "replica is one archive, without a recording 'room0'"),
        (("scannet", "scene0000_00"), "ScanNet is available only on request: apply at http"),
        (("scannetpp", ""), "is available only on request: apply at https://scannetpp"),
    ],
)
def test_unknown_names_are_explained(asked: tuple[str, str], says: str) -> None:
    with pytest.raises(DownloadError, match=re.escape(says)):
        find_recording(*asked)


def test_the_catalogue_is_listed() -> None:
    assert {line.split()[0] for line in describe_sets()} == set(SETS)
    lines = list(describe_recordings("tum"))
    assert any(re.fullmatch(r"fr1/desk +344\.0 MB", line) for line in lines), lines


@pytest.mark.parametrize("public", PUBLIC, ids=lambda public: public.title)
def test_the_catalogue_is_consistent(public: PublicSet) -> None:
    """Folders and archive names are unique, addresses use https, sizes are within the limits."""
    folders = [recording.folder for recording in public.recordings.values()]
    archives = [archive for recording in public.recordings.values() for archive in recording.archives]
    assert len(set(folders)) == len(folders) and len({archive.name for archive in archives}) == len(archives)
    assert public.licence and public.page.startswith("http")
    for archive in archives:
        parts = urlsplit(archive.url)
        assert parts.scheme == "https" and parts.hostname and not parts.query
        assert re.fullmatch(r"(sha256:[0-9a-f]{8}([0-9a-f]{56})?|md5:[0-9a-f]{32})?", archive.checksum)
        assert archive.name.endswith((".tgz", ".tar.gz", ".zip")) or archive.into
    for folder in folders:
        assert re.fullmatch(r"[\w-]+", folder)
