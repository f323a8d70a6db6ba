"""`kernel`: numba's compiler, also where the installation is read-only and the user has no home folder."""

import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from inspect import unwrap
from pathlib import Path
from typing import Any

import numba


def kernel(function: Any = None, *, cache: bool = True, **options: Any) -> Any:
    """Decorator that compiles a function, which then releases the GIL. `options` are those of `numba.njit`.

    A run-time type checker's wrapper is removed. The result is cached next to the source or in the
    user's cache, else in a private folder for temporary files, else not at all.
    """
    if function is None:
        return lambda function: kernel(function, cache=cache, **options)
    compile_function: Callable[..., Any] = numba.njit(nogil=True, error_model="numpy", **options)
    compiled = compile_function(unwrap(function))
    if not cache:
        return compiled
    try:
        compiled.enable_caching()
    except RuntimeError:  # numba found no folder that it can write to
        folder = _private_folder()
        if folder:
            config: Any = numba.config
            before = config.CACHE_DIR
            config.CACHE_DIR = str(folder)
            with suppress(RuntimeError):
                compiled.enable_caching()
            config.CACHE_DIR = before
    return compiled


def _private_folder() -> Path | None:
    """A folder for temporary files that only this user can write to, because cached code is executed; None if none."""
    user = os.getuid() if hasattr(os, "getuid") else "cache"
    try:
        folder = Path(tempfile.gettempdir()) / f"viewmend-{user}"
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        is_private = not hasattr(os, "getuid") or (found.st_uid == user and not found.st_mode & 0o077)
    except OSError:
        return None
    return folder if is_private and folder.is_dir() and not folder.is_symlink() else None
