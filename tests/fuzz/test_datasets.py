"""Published data sets' files with something wrong in them are read or refused, soon and in little memory."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference.foreign_studios import (
    write_actorshq,
    write_dna,
    write_easyvolcap,
    write_genebody,
    write_mvhumannet,
    write_panoptic,
    write_riftcast,
    write_zju,
)
from reference.random_rigs import named, random_rig
from test_parsers import FUZZED, changed, held, reworded, spoilt, text_of

from viewmend.capture.plain import open_capture

META = '{"type": "VCI", "version": "2.0", "dataset": {"frame_count": 9}, "volume": {"position": [0, 1, 0], "scale": 1}}'
WRITERS = {
    "dna": (write_dna, "{:02d}", "*.smc"),
    "riftcast": (lambda *told: write_riftcast(*told, meta=META), "{}", "*.json"),
    "riftcast masks": (write_riftcast, "{}", "frame_00001/mask/*.bin"),
    "zju": (write_zju, "Camera_B{}", "annots.npy"),
    "genebody": (write_genebody, "{:02d}", "annots.npy"),
    "mvhumannet": (write_mvhumannet, "CC32871A0{:02d}", "camera_*.*"),
    "actorshq": (lambda *told: write_actorshq(*told, boxes=[[0, 0, 0, 1, 1, 1]]), "Cam{:03d}", "**/*.csv"),
    "panoptic": (write_panoptic, "00_{:02d}", "*.json"),
    "easyvolcap": (write_easyvolcap, "{:02d}", "*.yml"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_files_of_data_sets(kind, tmp_path):
    write, pattern, files = WRITERS[kind]
    rig = named([camera | {"width": 32, "height": 24} for camera in random_rig(3, 2)], pattern)
    frame = {"dna": "1", "riftcast": "00001", "riftcast masks": "00001"}.get(kind, "000001")
    write(tmp_path, [c | {"width": 512, "height": 375} if kind == "mvhumannet" else c for c in rig], [frame])
    assert len(open_capture(tmp_path).cameras) == 2
    found = sorted(tmp_path.glob(files))
    assert found
    for file in found:
        fuzz_file(tmp_path, file)


def fuzz_file(folder, file):
    good = file.read_bytes()
    others = st.nothing()
    if file.suffix == ".json":
        others = changed(json.loads(good)).map(text_of)
    elif file.suffix not in (".npy", ".pkl", ".smc", ".bin"):
        others = reworded(good.decode().replace(",", " , "))

    @FUZZED
    @given(others | spoilt(good))
    def fuzz(data):
        file.write_bytes(data)
        held(lambda: open_capture(folder).read(0))

    fuzz()
    file.write_bytes(good)
