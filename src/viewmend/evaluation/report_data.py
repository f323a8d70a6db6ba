"""A report for programs: JSON of all, CSV of one line for each figure."""

import csv
import io
import json
from dataclasses import asdict, astuple, fields

from viewmend.evaluation.averages import Table, speed
from viewmend.evaluation.cells import Cell
from viewmend.evaluation.records import Record, Records, wide
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
        "tables": [_table(table) for table in report.tables],
        "kinds": [_table(table) for table in report.kinds],
        "cells": [_cell(cell, report.scores) for cell in report.cells],
    }
    return json.dumps(value, indent=1, allow_nan=False) + "\n"


def report_csv(report: Report) -> str:
    """One line for each figure: scene, method, region, metric, value, and what kind of scene it is."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(f.name for f in fields(Record))
    writer.writerows(astuple(record) for record in report.scores)
    return file.getvalue()


def _table(table: Table) -> dict[str, object]:
    rows = [asdict(row) | {"scores": _means(row.scores)} for row in table.rows]
    return {**asdict(table), "rows": rows}


def _means(scores: Records) -> dict[str, float | None]:
    """One method's means, by the names of metric and region."""
    return {f"{r.metric}_{r.region}": scores.mean(r.metric, r.region) for r in scores}


def _cell(cell: Cell, scores: Records) -> dict[str, object]:
    taken = speed([cell])
    return {
        "scene": cell.key.scene,
        "set": cell.set,
        "rig": cell.rig,
        "style": cell.style,
        "method": cell.key.method,
        "error": cell.error,
        **_means(scores.where(scene=cell.key.scene, method=cell.key.method)),
        **{name: getattr(taken, name, None) for name in ("fps", "ms_p50", "ms_p95")},
        "frames": len(cell.frames),
        "thin_frames": len(cell.frames) - len(wide(cell.frames)),
        "empty_frames": sum(frame.hole_px == 0 for frame in cell.frames),
        "commit": cell.provenance.commit,
        "file": f"{cell.key.stem}.json",
    }
