"""What several commands check of their options before they begin."""

from pathlib import Path


def check_device(name: str) -> None:
    """ValueError if this device is not there."""
    import torch

    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"expected a device that is there, got '{name}'; use --device cpu")


def check_people(performers: Path | None, motions: Path | None) -> None:
    """ValueError unless both are there, or neither is given."""
    if (performers is None) != (motions is None):
        raise ValueError("expected --performers and --motions together, got one of them; give both folders")
    for folder in (performers, motions):
        if folder is not None and not folder.exists():
            raise ValueError(f"{folder}: expected people or motions, found nothing; check --performers and --motions")
