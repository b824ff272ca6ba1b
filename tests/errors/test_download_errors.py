"""sigmasplat download: each error is one line with exit code 2; a success ends with the next command."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

import file_server as acts
from archives import folder_content, tar_gz
from file_server import Act, FileServer, serving
from sigmasplat import cli
from sigmasplat.plugins.download import fetch as fetching
from sigmasplat.plugins.download.catalogue import PublicRecording, PublicSet, RemoteFile

DESK = "rgbd_dataset_freiburg1_desk"


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tiny_tum: Path) -> Iterator[FileServer]:
    """Serve a tiny recording as data set `tiny`, recording `desk`."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.chdir(tiny_tum.parent)
    with serving() as server:
        server.files["/desk.tgz"] = tar_gz(folder_content(tiny_tum, f"{DESK}/"))
        server.files["/bare.tgz"] = tar_gz({"bare/readme": b"nothing else"})
        recordings = {
            name: PublicRecording(name, (RemoteFile(server.url(f"/{name}.tgz")),)) for name in ("desk", "bare", "gone")
        }
        tiny = PublicSet("Tiny", "http://page", "free", "tiny", recordings)
        monkeypatch.setattr("sigmasplat.plugins.download.catalogue.SETS", {"tiny": tiny})
        monkeypatch.setattr(fetching, "ATTEMPTS", 2)
        monkeypatch.setattr(fetching, "WAIT_S", 0.001)
        yield server


def said(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> tuple[str, str]:
    """Run sigmasplat download; return its standard output and standard error."""
    with pytest.raises(SystemExit) as left:
        cli.main(["download", *arguments])
    spoken = capsys.readouterr()
    assert left.value.code == code, spoken
    return spoken.out, spoken.err


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run a command that must fail; return its error line."""
    line = said(capsys, 2, *arguments)[1]
    assert line.startswith("sigmasplat: ") and line.count("\n") == 1
    return line


def test_a_recording_can_be_run_afterwards(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    out, err = said(capsys, 0, "tiny", "desk")
    lines = out.splitlines()
    assert lines[0] == "Tiny desk: size not published → data/tiny/desk"
    assert lines[1].startswith("terms: free (http://page)")
    assert any(line.startswith("download desk.tgz ") and line.endswith("kB") for line in lines), lines
    assert lines[-1] == "next: sigmasplat run data/tiny/desk" and err == ""
    again, _ = said(capsys, 0, "tiny", "desk")
    assert again.splitlines() == ["data/tiny/desk exists already; --overwrite downloads it again", lines[-1]]
    assert len(server.ranges) == 1


def test_options(server: FileServer, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out, _ = said(capsys, 0, "tiny", "desk", "--out", str(tmp_path / "here"))
    assert f"run {tmp_path / 'here/tiny/desk'}" in out
    said(capsys, 0, "tiny", "desk", "--out", str(tmp_path / "here"), "--overwrite")
    assert not (tmp_path / "here/tiny/desk.tgz").exists()


@pytest.mark.parametrize("arguments", [[], ["list"]])
def test_the_list_needs_no_network(
    arguments: list[str], server: FileServer, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said(capsys, 0, *arguments) == ("tiny       Tiny · 3 recordings · free\n", "")
    assert [line.split()[0] for line in said(capsys, 0, "list", "tiny")[0].splitlines()] == ["desk", "bare", "gone"]
    assert server.ranges == []


def test_offline(server: FileServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*arguments: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    line = refused(capsys, "tiny", "desk")
    assert "cannot reach 127.0.0.1 (Name or service not known); is this machine online" in line
    assert folder_content(Path("data")) == {}


@pytest.mark.parametrize(
    ("first", "says"),
    [
        ([acts.status(404)], "/desk.tgz is not available (HTTP 404 Not Found); it may have moved or require a login"),
        ([acts.status(403)], "(HTTP 403 Forbidden)"),
        ([acts.status(503)] * 2, "is busy or out of service (HTTP 503 Service Unavailable); try later"),
        ([acts.drop_after(700), acts.drop_after(0)], "closed the connection after 700 of "),
        ([acts.web_page], "answers with a web page, not the file; is there a login page in between?"),
        ([acts.says_length(-50)], "desk.tgz is damaged ("),
    ],
    ids=["404", "403", "503", "drops", "login page", "cut short"],
)
def test_servers_that_fail(first: list[Act], says: str, server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    server.acts = list(first)
    assert says in refused(capsys, "tiny", "desk")
    assert not Path("data/tiny/desk").exists() and not Path("data/tiny/desk.tgz").exists()


def test_an_unreadable_download_is_reported(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    assert "downloaded, but it cannot be run: unknown format: data/tiny/bare" in refused(capsys, "tiny", "bare")


def test_a_foreign_folder(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    Path("data/tiny/desk").mkdir(parents=True)
    assert "data/tiny/desk exists and was not created by this command" in refused(capsys, "tiny", "desk", "--overwrite")


def test_out_is_a_file(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    Path("data").write_text("")
    assert "data/tiny: cannot be written (" in refused(capsys, "tiny", "desk")


def test_all_names_are_checked_before_the_download(server: FileServer, capsys: pytest.CaptureFixture[str]) -> None:
    assert "no recording 'dsk' in tiny (did you mean desk?)" in refused(capsys, "tiny", "desk", "dsk")
    assert server.ranges == []


def test_ctrl_c(server: FileServer, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("sigmasplat.plugins.download.downloader.fetch", interrupted)
    out, err = said(capsys, 130, "tiny", "desk")
    assert out.splitlines()[-1] == "the part downloaded so far is kept; the same command resumes the download"
    assert err == "sigmasplat: interrupted\n"
