"""Downloads from a server of this machine: whole and proved, or a sentence that says what to do."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from typer.testing import CliRunner

from calstudy.base import package_files
from calstudy.base.errors import InputError
from calstudy.base.files import sha256
from calstudy.base.package_files import BEAM, MWA_FILES, download
from calstudy.cli.main import app


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    """Serve a folder with one file; yields the address."""
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / BEAM.name).write_bytes(b"a beam" * 1000)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


@pytest.fixture
def served(server, tmp_path, monkeypatch) -> Path:
    """Let the beam be fetched from this machine; returns the file that is served."""
    file = tmp_path / "served" / BEAM.name
    fake = replace(BEAM, url=f"{server}/{BEAM.name}", sha256=sha256(file))
    monkeypatch.setitem(MWA_FILES, "beam", fake)
    return file


def test_a_fetched_beam_is_the_file_and_is_fetched_once(served, tmp_path):
    result = CliRunner().invoke(app, ["data", "fetch", "beam", "--directory", str(tmp_path / "kept")])
    assert result.exit_code == 0, result.output
    path = tmp_path / "kept" / BEAM.name
    assert result.stdout.strip().endswith(str(path))
    assert path.read_bytes() == served.read_bytes()
    served.unlink()
    assert MWA_FILES["beam"].fetch(tmp_path / "kept", progress=False) == path
    path.write_bytes(b"changed")
    with pytest.raises(InputError, match="refused it \\(404\\)"):
        MWA_FILES["beam"].fetch(tmp_path / "kept", progress=False)


def test_another_file_is_not_kept(served, tmp_path):
    served.write_bytes(b"something else")
    with pytest.raises(InputError, match=r"its SHA-256 is another; install mwa_pb 1\.1, or set instrument\.beam\.path"):
        MWA_FILES["beam"].fetch(tmp_path / "kept", progress=False)
    assert list((tmp_path / "kept").iterdir()) == []


def test_without_a_network_it_says_what_to_do(server, tmp_path):
    nobody = server.rsplit(":", 1)[0] + ":9"
    with pytest.raises(InputError, match=r"file\.h5: there is no connection to 127\.0\.0\.1; do this"):
        download(f"{nobody}/file.h5", tmp_path / "file.h5", "do this", progress=False)
    (tmp_path / "blocked").write_text("not a folder")
    with pytest.raises(InputError, match="cannot be downloaded to"):
        download(f"{server}/{BEAM.name}", tmp_path / "blocked" / "file.h5", "do this", progress=False)


@pytest.mark.parametrize("name", MWA_FILES)
def test_files_of_the_package_are_those_that_would_be_fetched(name, monkeypatch, tmp_path):
    file = MWA_FILES[name]
    assert sha256(file.find()) == file.sha256
    monkeypatch.setattr(package_files, "find_spec", lambda _: None)
    monkeypatch.setattr(package_files, "default_directory", lambda: tmp_path / "cache")
    with pytest.raises(InputError, match=f"calstudy data fetch {name}', install mwa_pb 1.1, or"):
        file.find()
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / file.name).write_bytes(b"fetched")
    assert file.find().read_bytes() == b"fetched"


def test_downloads_have_a_place_of_the_users():
    assert package_files.default_directory().is_absolute()
