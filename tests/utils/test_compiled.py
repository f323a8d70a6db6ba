import numba

from viewmend.utils import compiled


def double(value):
    return 2 * value


def test_read_only_installation_caches_in_a_private_folder_or_not_at_all(monkeypatch, tmp_path):
    monkeypatch.setattr(
        numba.config, "CACHE_LOCATOR_CLASSES", "UserProvidedCacheLocator"
    )  # as if nothing is writable
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(compiled.tempfile, "gettempdir", lambda: str(tmp_path))
    function = compiled.kernel(double)
    assert function(21) == 42
    assert list(tmp_path.glob("viewmend-*/**/*.nbi")) and numba.config.CACHE_DIR == ""
    folder = next(tmp_path.glob("viewmend-*"))
    assert folder.stat().st_mode & 0o077 == 0
    folder.chmod(0o777)  # someone else could place code there
    assert compiled._private_folder() is None
    assert compiled.kernel(double)(4) == 8
