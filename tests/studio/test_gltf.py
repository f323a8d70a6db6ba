import base64
import json
import struct

import pytest
import torch
from studio.tiny_performer import JOINTS, write_glb

from viewmend.data.errors import CaptureError
from viewmend.studio.gltf import load_character
from viewmend.studio.retarget import node_matrices


def read(path):
    """The JSON part of a .glb, and what comes after it."""
    data = path.read_bytes()
    end = 20 + struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20:end]), data[end:]


def edited(path, change):
    """Rewrite the JSON part of a .glb."""
    document, rest = read(path)
    change(document)
    return write_glb(path, document, rest)


def test_reads_the_rest_pose(character_file):
    character = load_character(character_file)
    mesh = character.rest.mesh
    assert len(mesh.vertices) == 8 * len(JOINTS) and len(mesh.faces) == 12 * len(JOINTS)
    world = node_matrices(character, torch.eye(4))
    place = {n.name: world[i, :3, 3] for i, n in enumerate(character.nodes)}
    for name, (_, position) in JOINTS.items():
        torch.testing.assert_close(
            place[name], torch.tensor(position, dtype=torch.float32), atol=1e-5, rtol=0
        )
    bound = world[character.node_of_joint] @ character.joint_from_bind
    torch.testing.assert_close(bound, torch.eye(4).expand_as(bound), atol=1e-4, rtol=0)


def test_textures_are_rgb_with_their_first_row_on_top(character_file):
    (texture,) = load_character(character_file).rest.textures
    assert texture.shape == (3, 8, 16)
    assert texture[:, 0, 0].tolist() == [1, 0, 0] and texture[:, 0, 15].tolist() == [0, 1, 0]


def test_a_gltf_with_a_data_uri_reads_the_same(character_file):
    document, rest = read(character_file)
    document["buffers"][0]["uri"] = "data:x;base64," + base64.b64encode(rest[8:]).decode()
    path = character_file.with_suffix(".gltf")
    path.write_text(json.dumps(document))
    a, b = load_character(character_file), load_character(path)
    torch.testing.assert_close(a.rest.mesh.vertices, b.rest.mesh.vertices)
    torch.testing.assert_close(a.joint_from_bind, b.joint_from_bind)


def test_color_factors_tint_and_replace_textures(character_file):
    def change(document):
        document["materials"][0]["pbrMetallicRoughness"] = {"baseColorFactor": [1, 0.2140, 0, 1]}

    (texture,) = load_character(edited(character_file, change)).rest.textures
    # 0.214 of linear light is 0.5 in sRGB.
    torch.testing.assert_close(texture[:, 0, 0], torch.tensor([1, 0.5, 0]), atol=0.01, rtol=0)


def test_an_unskinned_part_hangs_on_its_node(character_file):
    def change(document):
        hand = next(n for n in document["nodes"] if n["name"] == "LeftHand")
        hand["children"] = [len(document["nodes"])]
        document["nodes"].append({"name": "ring", "mesh": 0})

    character = load_character(edited(character_file, change))
    last = character.node_of_joint[character.joints[-1, 0]]
    assert character.nodes[int(last)].name == "ring"
    assert character.nodes[character.nodes[int(last)].parent].name == "LeftHand"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["asset"].update(version="1.0"), "version 2.0"),
        (lambda d: d["asset"].update(version="1" * 5000), "version 2.0"),
        (lambda d: d.update(extensionsRequired=["KHR_draco_mesh_compression"]), "draco"),
        (lambda d: d.update(extensionsRequired=["EXT_none"] * 3000), "needs extensions"),
        (lambda d: d["nodes"][-1].pop("skin"), "no skin"),
        (lambda d: d["nodes"][-1].pop("mesh"), "no triangles"),
        (lambda d: d["bufferViews"][0].update(byteLength=10**7), "cut short"),
        (lambda d: d["accessors"][0].update(count=10**5), "accessor 0"),
        (lambda d: d["accessors"][0].update(sparse={}), "sparse"),
        (lambda d: d["images"][0].update(bufferView=0), "JPEG or PNG"),
        (lambda d: d["materials"].clear(), "materials number 0"),
    ],
)
def test_bad_documents_say_what_is_wrong(character_file, change, message):
    with pytest.raises(CaptureError, match=message) as caught:
        load_character(edited(character_file, change))
    assert "sticks.glb" in str(caught.value) and len(str(caught.value)) < 500


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello", "starts with"),
        (b"glTF\x02\0\0\0\xff\0\0\0", "cut short"),
        (None, "cannot be read"),
        (..., "cut short"),
    ],
)
def test_bad_containers_say_what_is_wrong(tmp_path, character_file, content, message):
    path = tmp_path / "bad.glb"
    if content is not None:
        path.write_bytes(character_file.read_bytes()[:-100] if content is ... else content)
    with pytest.raises(CaptureError, match=message):
        load_character(path)
