"""Exported models keep the islands of hull artefacts, so the model that they are compared with keeps them, too."""

import pytest
import torch

from viewmend.models.views import prediction


@pytest.fixture(autouse=True)
def remains_stay(monkeypatch):
    monkeypatch.setattr(
        prediction, "artefact_islands", lambda colour, alpha, predicted: torch.zeros_like(predicted)
    )
