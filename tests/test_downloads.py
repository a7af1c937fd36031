"""Downloads from a server of this machine: whole and proved, or a sentence that says what to do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner

from calstudy.base import downloads
from calstudy.base.downloads import download
from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.base.package_files import PackageFile
from calstudy.cli.main import app
from calstudy.instrument import beam_file


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """Serve a folder with one file; yields the address."""
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / beam_file.FILE).write_bytes(b"a beam" * 1000)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


@pytest.fixture
def served(server, tmp_path, monkeypatch) -> Path:
    """Let the beam be fetched from this machine; returns the file that is served."""
    file = tmp_path / "served" / beam_file.FILE
    monkeypatch.setattr(beam_file, "URL", f"{server}/{beam_file.FILE}")
    monkeypatch.setattr(beam_file, "SHA256", sha256(file))
    return file


def test_a_fetched_beam_is_the_file_and_is_fetched_once(served, tmp_path):
    result = CliRunner().invoke(app, ["data", "fetch", "beam", "--directory", str(tmp_path / "kept")])
    assert result.exit_code == 0, result.output
    path = tmp_path / "kept" / beam_file.FILE
    assert result.stdout.strip().endswith(str(path))
    assert path.read_bytes() == served.read_bytes()
    served.unlink()
    assert beam_file.fetch_beam(tmp_path / "kept", progress=False) == path
    path.write_bytes(b"changed")
    with pytest.raises(InputError, match="refused it \\(404\\)"):
        beam_file.fetch_beam(tmp_path / "kept", progress=False)


def test_another_file_is_not_kept(served, tmp_path):
    served.write_bytes(b"something else")
    with pytest.raises(InputError, match=r"its SHA-256 is another; set instrument\.beam\.path to your own copy"):
        beam_file.fetch_beam(tmp_path / "kept", progress=False)
    assert list((tmp_path / "kept").iterdir()) == []


def test_without_a_network_it_says_what_to_do(server, tmp_path):
    nobody = server.rsplit(":", 1)[0] + ":9"
    with pytest.raises(InputError, match=r"file\.h5: there is no connection to 127\.0\.0\.1; do this"):
        download(f"{nobody}/file.h5", tmp_path / "file.h5", "do this", progress=False)
    (tmp_path / "blocked").write_text("not a folder")
    with pytest.raises(InputError, match="cannot be downloaded to"):
        download(f"{server}/{beam_file.FILE}", tmp_path / "blocked" / "file.h5", "do this", progress=False)


def test_the_packaged_beam_is_the_one_that_would_be_fetched(monkeypatch, tmp_path):
    assert sha256(beam_file.find_beam()) == beam_file.SHA256
    monkeypatch.setattr(beam_file, "PACKAGED", PackageFile("mwa_pb", "data/missing.h5"))
    monkeypatch.setattr(beam_file, "default_directory", lambda: tmp_path / "cache")
    with pytest.raises(InputError, match="calstudy data fetch beam"):
        beam_file.find_beam()
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / beam_file.FILE).write_bytes(b"fetched")
    assert beam_file.find_beam().read_bytes() == b"fetched"


def test_downloads_have_a_place_of_the_users():
    assert downloads.default_directory().is_absolute()
