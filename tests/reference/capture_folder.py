"""The description of a capture folder, read and changed in place."""

import json


def description_of(folder):
    return json.loads((folder / "cameras.json").read_text())


def edit_description(folder, change):
    content = description_of(folder)
    change(content)
    (folder / "cameras.json").write_text(json.dumps(content))


def remove_masks(folder):
    edit_description(folder, lambda content: [camera.pop("mask") for camera in content["cameras"]])
