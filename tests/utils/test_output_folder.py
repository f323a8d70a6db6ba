"""One run at a time, and nobody's files are replaced but our own."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from viewmend.cli import console
from viewmend.cli.evaluate import report_folder
from viewmend.data.native_writer import atomic_folder
from viewmend.utils.output_folder import OutputFolder

NAMES = ("pictures", "sheet.png")


def published(out, pictures=("0", "1")):
    with OutputFolder(out) as folder:
        (folder.draft / "pictures").mkdir()
        for name in pictures:
            (folder.draft / "pictures" / f"{name}.png").write_text(f"picture {name} of {len(pictures)}")
        (folder.draft / "sheet.png").write_text(f"sheet of {len(pictures)}")
        folder.publish(*NAMES)


def seen(out):
    return sorted(
        p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file() and ".viewmend" not in p.parts
    )


def test_what_a_run_made_the_next_one_replaces(tmp_path):
    published(tmp_path / "out", ("0", "1", "2"))
    (tmp_path / "out/mine.txt").write_text("mine")
    published(tmp_path / "out")
    assert seen(tmp_path / "out") == ["mine.txt", "pictures/0.png", "pictures/1.png", "sheet.png"]
    assert (tmp_path / "out/sheet.png").read_text() == "sheet of 2"


def test_a_signal_waits_until_what_is_unfinished_is_gone(tmp_path, monkeypatch):
    remove = shutil.rmtree

    def disturbed(path, **how):
        signal.raise_signal(signal.SIGTERM)
        remove(path, **how)

    for written in (OutputFolder, atomic_folder):
        out = tmp_path / written.__name__
        with console.exit_on_sigterm(), pytest.raises(SystemExit) as ended, written(out) as folder:
            (folder.draft if isinstance(folder, OutputFolder) else folder).mkdir(exist_ok=True)
            monkeypatch.setattr(shutil, "rmtree", disturbed)
        monkeypatch.undo()
        assert ended.value.code == 143 and not list(tmp_path.rglob("draft")) and not list(tmp_path.glob(".*"))


def test_a_signal_waits_until_the_results_are_in_place(tmp_path, monkeypatch):
    published(tmp_path / "out", ("0", "1", "2"))
    rename = Path.rename

    def disturbed(path, target):
        signal.raise_signal(signal.SIGTERM)
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", disturbed)
    with console.exit_on_sigterm(), pytest.raises(SystemExit):
        published(tmp_path / "out")
    assert seen(tmp_path / "out") == ["pictures/0.png", "pictures/1.png", "sheet.png"]
    assert (tmp_path / "out/sheet.png").read_text() == "sheet of 2"


@pytest.mark.parametrize(
    "name", ["pictures/000123.png", "pictures/0.png", "pictures/deep/a.txt", "sheet.png"]
)
@pytest.mark.parametrize("before", [True, False], ids=["after a run", "before any"])
def test_what_somebody_put_there_stays(name, before, tmp_path):
    if before:
        published(tmp_path)
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("precious")
    there = seen(tmp_path)
    with pytest.raises(
        ValueError, match=f"{name}: expected no such file, or an unchanged one from an earlier run"
    ):
        published(tmp_path)
    assert path.read_text() == "precious" and seen(tmp_path) == there


@pytest.mark.parametrize("name", ["pictures", "sheet.png"])
def test_links_are_nobodys_results(name, tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "theirs")
    with pytest.raises(ValueError, match="expected no such file"):
        published(tmp_path / "out")


def test_two_runs_never_write_to_one_folder(tmp_path):
    program = (
        "import sys; from pathlib import Path; from viewmend.utils.output_folder import OutputFolder\n"
        "OutputFolder(Path(sys.argv[1])).__enter__()\n"
    )
    with OutputFolder(tmp_path):
        other = subprocess.run(
            [sys.executable, "-c", program, str(tmp_path)], capture_output=True, check=False
        )
        assert other.returncode == 1 and b"got one in use" in other.stderr
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False).returncode == 0


def test_what_a_killed_run_left_is_removed(tmp_path):
    program = (
        "import os, sys; from pathlib import Path; from viewmend.utils.output_folder import OutputFolder as F\n"
        "from viewmend.utils.atomic_writes import write_atomically\n"
        "folder = F(Path(sys.argv[1])).__enter__()\n"
        "(folder.draft / 'a').write_text('half')\n"
        "write_atomically(folder.path / 'b', lambda path: (path.write_text('half'), os.kill(os.getpid(), 9)))\n"
    )
    assert subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False).returncode == -9
    left = [p.name for p in tmp_path.rglob("*") if p.is_file()]
    assert "a" in left and any(name.startswith(".half-") and name.endswith("-b") for name in left)
    with OutputFolder(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_folder_in_which_nothing_was_made_is_gone(tmp_path):
    with pytest.raises(OSError, match="broken"), OutputFolder(tmp_path / "out") as folder:
        (folder.draft / "a").write_text("half")
        raise OSError("broken")
    assert list(tmp_path.iterdir()) == []


def test_files_that_change_are_known_by_their_names(tmp_path):
    with OutputFolder(tmp_path) as folder:
        folder.record("log.jsonl", "shown-*.png", changing=True)
    for name in ("log.jsonl", "shown-3.png"):
        (tmp_path / name).write_text("anything")
    with OutputFolder(tmp_path) as folder:
        folder.check_own_files("*")
        (tmp_path / "notes").write_text("mine")
        with pytest.raises(ValueError, match="notes: expected"):
            folder.check_own_files("*")


def test_files_are_listed_once_they_are_made(tmp_path):
    with OutputFolder(tmp_path) as folder:
        assert not folder.listed
        (tmp_path / "report.md").write_text("a")
        folder.record("report.*")
    with OutputFolder(tmp_path) as folder:
        assert folder.listed
        folder.check_own_files("report.*")
        (tmp_path / "report.md").write_text("edited")
        with pytest.raises(ValueError, match="report"):
            folder.check_own_files("report.*")


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"files": 3}', '{"files": {"sheet.png": 3}}'])
def test_a_damaged_manifest_knows_nothing(text, tmp_path):
    published(tmp_path)
    (tmp_path / ".viewmend/files.json").write_text(text)
    with pytest.raises(ValueError, match="expected no such file"):
        published(tmp_path)


@pytest.mark.parametrize(
    "name", [".viewmend", ".viewmend/draft", ".viewmend/lock", ".viewmend/files.json", ".half-x"]
)
def test_links_lead_no_run_to_what_is_elsewhere(name, tmp_path):
    theirs, out = tmp_path / "theirs", tmp_path / "out"
    (theirs / "draft").mkdir(parents=True)
    (theirs / "draft/precious").write_text("precious")
    (theirs / "lock").write_text("precious")
    (out / name).parent.mkdir(parents=True)
    (out / name).symlink_to(theirs / ("lock" if name.endswith(("lock", "json", "x")) else ""))
    with contextlib.suppress(ValueError, OSError):
        published(out)
    assert (theirs / "draft/precious").read_text() == (theirs / "lock").read_text() == "precious"
    assert seen(theirs) == ["draft/precious", "lock"]


def test_a_folder_that_looks_unfinished_is_nobodys(tmp_path):
    (tmp_path / ".half-notes").mkdir()
    (tmp_path / ".half-notes/mine").write_text("mine")
    published(tmp_path)
    assert (tmp_path / ".half-notes/mine").read_text() == "mine"


def test_what_a_run_leaves_is_removed_while_it_still_has_the_lock(tmp_path, monkeypatch):
    """Else it could be the next run's."""
    locked, rmtree = [], shutil.rmtree
    folder = OutputFolder(tmp_path / "out")
    removed = lambda *a, **k: (locked.append(folder._lock.is_locked), rmtree(*a, **k))  # noqa: E731
    with folder:
        monkeypatch.setattr(shutil, "rmtree", removed)
    assert locked == [True, True] and not (tmp_path / "out").exists()


def test_a_report_that_was_killed_half_way_is_made_again(tmp_path):
    out = tmp_path / "out"
    with report_folder(out):
        (out / "report.md").write_text("first")
    program = (
        "import os, sys; from pathlib import Path; from viewmend.cli.evaluate import report_folder\n"
        "out = Path(sys.argv[1]); held = report_folder(out); held.__enter__()\n"
        "(out / 'report.md').write_text('second'); (out / 'cells').mkdir(); (out / 'cells/.half-9-x').write_text('x')\n"
        "os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", program, str(out)], check=False).returncode == -9
    with report_folder(out):
        assert list((out / "cells").iterdir()) == []
        (out / "report.md").write_text("third")
    (out / "report.md").write_text("edited")
    with pytest.raises(ValueError, match=r"report\.md"), report_folder(out):
        pass
    (out / "report.md").unlink()
    (out / "report.csv").write_text("mine")
    with pytest.raises(ValueError, match=r"report\.csv"), report_folder(out):
        pass
    assert (out / "report.csv").read_text() == "mine"


WITHOUT_LOCKS = [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL, errno.EIO, errno.EACCES]


@pytest.mark.parametrize("code", WITHOUT_LOCKS, ids=errno.errorcode.get)
def test_a_file_system_without_locks_is_used_and_reported(code, tmp_path, monkeypatch, caplog):
    def flock(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", flock)
    published(tmp_path / "out")
    assert seen(tmp_path / "out") == ["pictures/0.png", "pictures/1.png", "sheet.png"]
    assert [path.name for path in (tmp_path / "out/.viewmend").iterdir()] == ["files.json"]
    (message,) = (record.message for record in caplog.records)
    assert str(tmp_path / "out") in message and "no file locks" in message and "local disk" in message
    with OutputFolder(tmp_path / "out"):
        in_use = pytest.raises(ValueError, match="in use; wait for that run to finish")
        with in_use, OutputFolder(tmp_path / "out"):
            pass
    published(tmp_path / "out", ("0",))


def test_a_killed_run_does_not_block_a_folder_without_locks(tmp_path):
    program = (
        "import fcntl, os, sys; from pathlib import Path; from viewmend.utils.output_folder import OutputFolder\n"
        "def flock(*_): raise OSError(37, 'No locks available')\n"
        "fcntl.flock = flock; OutputFolder(Path(sys.argv[1])).__enter__()\n"
        "if sys.argv[2] == 'killed': os.kill(os.getpid(), 9)\n"
    )
    for way in ("killed", "again"):
        done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "out"), way], check=False)
        assert done.returncode == {"killed": -9, "again": 0}[way]
