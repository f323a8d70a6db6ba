"""Reports name the commit that their figures were computed with."""

import subprocess

from viewmend.evaluation import provenance


def git(folder, *arguments):
    command = ["git", "-c", "user.name=a", "-c", "user.email=a@example.org", *arguments]
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


def test_the_repository_of_another_project_is_not_named(tmp_path, monkeypatch):
    package = tmp_path / "project/env/viewmend"
    package.mkdir(parents=True)
    (package / "provenance.py").write_text("")
    monkeypatch.setattr(provenance, "__file__", str(package / "provenance.py"))
    git(tmp_path / "project", "init", "--quiet")
    git(tmp_path / "project", "commit", "--quiet", "--allow-empty", "--message=theirs")
    assert provenance.provenance("cpu", 1, 1).commit == "unknown"
    git(package, "add", ".")
    git(package, "commit", "--quiet", "--message=ours")
    assert provenance.provenance("cpu", 1, 1).commit == git(package, "rev-parse", "--short", "HEAD")
