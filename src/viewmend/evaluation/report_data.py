"""A report for programs: JSON of all, CSV of one line for each cell."""

import csv
import io
import json
from dataclasses import asdict, fields

from viewmend.evaluation.averages import CellScores, MeanScores, speed
from viewmend.evaluation.report import RULES, Report


def report_json(report: Report) -> str:
    """Settings, tables, and each cell's means; its frames are in its own file."""
    value = {
        "protocol": report.protocol,
        "rules": RULES,
        "settings": asdict(report.settings),
        "methods": report.methods,
        "identities": report.identities,
        "missing": report.missing,
        "missing_networks": report.missing_networks,
        "origins": [asdict(origin) for origin in report.origins],
        "tables": [asdict(table) for table in report.tables],
        "kinds": [asdict(table) for table in report.kinds],
        "cells": [_cell(cell) for cell in report.cells],
    }
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def report_csv(report: Report) -> str:
    """One line for each cell; empty where there is no score."""
    rows = [_cell(cell) for cell in report.cells]
    file = io.StringIO()
    writer = csv.DictWriter(file, list(rows[0]) if rows else ["scene"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def _cell(averaged: CellScores) -> dict[str, object]:
    cell = averaged.cell
    taken = speed([averaged])
    return {
        "scene": cell.key.scene,
        "set": cell.set,
        "rig": cell.rig,
        "style": cell.style,
        "method": cell.key.method,
        "error": cell.error,
        **{f.name: getattr(averaged.scores, f.name) for f in fields(MeanScores)},
        **{name: getattr(taken, name, None) for name in ("fps", "ms_p50", "ms_p95")},
        "frames": averaged.frames,
        "thin_frames": averaged.thin_frames,
        "empty_frames": averaged.empty_frames,
        "commit": cell.provenance.commit,
        "file": f"{cell.key.stem}.json",
    }
