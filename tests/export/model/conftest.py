"""Exported models keep the islands of hull artefacts, so the model that they are compared with keeps them, too."""

import pytest

from viewmend.models.views import prediction


@pytest.fixture(autouse=True)
def remains_stay(monkeypatch):
    monkeypatch.setattr(prediction, "artefact_islands", lambda rgba, predicted: None)
