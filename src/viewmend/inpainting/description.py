"""An inpainting model in figures."""

from dataclasses import dataclass
from pathlib import Path

from viewmend.inpainting.checkpoint import CARD, SHIPPED, load_network

LONGEST_CARD = 100_000
"""Bytes of a model card that are looked at."""


@dataclass(frozen=True)
class ModelDescription:
    """What `viewmend info` says of a model."""

    kind: str
    path: str
    parameters: int
    config: dict[str, object]
    card: str | None
    """What trained the model and what it scores, Markdown; None where nobody wrote it down."""


def describe_model(name_or_path: str) -> ModelDescription:
    """Load a model, so that a damaged one shows, and describe it.

    Raises:
        WeightsError: there is no such model, or it cannot be loaded.
    """
    network = load_network(name_or_path)
    folder = Path(name_or_path) if Path(name_or_path).is_dir() else SHIPPED / name_or_path
    card = folder / CARD
    return ModelDescription(
        kind="model",
        path=str(folder),
        parameters=sum(parameter.numel() for parameter in network.parameters()),
        config=network.config.to_dict(),
        card=_read(card) if card.is_file() else None,
    )


def _read(card: Path) -> str:
    with card.open("rb") as file:
        return file.read(LONGEST_CARD).decode(errors="replace")
