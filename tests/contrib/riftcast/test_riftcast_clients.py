"""RIFTCast's clients get RGB-D views; the client here is written from the protocol's description."""

import contextlib
import socket
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
import zstandard
from live.live_servers import CAMERAS, WAIT_S, running, wait_until
from reference.ball import BallCapture, camera_at, photograph

from viewmend.cli import main
from viewmend.contrib import riftcast as riftcast_service
from viewmend.contrib.riftcast import RiftcastClient, camera_of, parse, riftcast_extension
from viewmend.live.frame_source import RecordedSource
from viewmend.live.protocol import Limits, ProtocolError

NO_UPDATE, UPDATE, CAMERA_DATA = 4, 5, 10


@pytest.fixture(scope="module")
def served():
    """A port for RIFTCast's clients, and the render service of its server."""
    extension = riftcast_extension(0)
    source = RecordedSource(lambda: BallCapture(CAMERAS, 1))
    with running(source, limits=Limits(viewers=3), extensions=(extension,)) as server:
        yield extension.keywords["listener"].getsockname()[1], server.service


def client(port):
    return socket.create_connection(("127.0.0.1", port), timeout=WAIT_S)


def exactly(own, count):
    got = b""
    while len(got) < count:
        part = own.recv(count - len(got))
        if not part:
            raise ConnectionError("the server has closed the connection")
        got += part
    return got


def framed(message):
    return struct.pack(">I", len(message)) + message


def ask(own, payload):
    """The answer's task and body."""
    own.sendall(framed(payload))
    answer = exactly(own, struct.unpack(">I", exactly(own, 4))[0])
    major, minor, task = struct.unpack("<HHi", answer[:8])
    assert (major, minor) == (1, 3)
    return task, answer[8:]


def gl(camera, near=0.01, far=10.0):
    """View and projection of a camera as OpenGL has them, by way of a frustum: another derivation than the server's."""
    K, (width, height) = camera.K[0].double().numpy(), camera.size_px[0].tolist()
    left, right = -K[0, 2] / K[0, 0] * near, (width - K[0, 2]) / K[0, 0] * near
    top, bottom = K[1, 2] / K[1, 1] * near, -(height - K[1, 2]) / K[1, 1] * near
    projection = np.array([
        [2 * near / (right - left), 0, (right + left) / (right - left), 0],
        [0, 2 * near / (top - bottom), (top + bottom) / (top - bottom), 0],
        [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0, 0, -1, 0],
    ])  # fmt: skip
    view = camera.camera_from_world[0].double().numpy().copy()
    view[1:3] *= -1
    return view, projection


def request(view, projection, width, height, task=3, major=1):
    matrices = [np.asarray(m, "<f4").T.tobytes() for m in (view, projection)]
    body = struct.pack(">II", width, height) + b"".join(struct.pack(">I", len(m)) + m for m in matrices)
    return struct.pack("<HHi", major, 3, task) + body


def blobs(body):
    found = []
    while body:
        end = 4 + struct.unpack(">I", body[:4])[0]
        found.append(body[4:end])
        body = body[end:]
    return found


def image_of(own, payload):
    """Request until there is an image."""
    answers = []

    def is_answered():
        answers.append(ask(own, payload))
        assert answers[-1][0] in (NO_UPDATE, UPDATE)
        return answers[-1][0] == UPDATE

    wait_until(is_answered)
    return blobs(answers[-1][1])


def test_an_image_and_its_depth_can_be_unprojected(served):
    camera = camera_at(50, "t", size=64, height_m=0.4)
    camera = type(camera)(camera.names, camera.K + torch.tensor([[0, 0, 3.0], [0, 0, -2], [0, 0, 0]]),
                          camera.camera_from_world, camera.size_px)  # fmt: skip
    view, projection = gl(camera)
    with client(served[0]) as own:
        task, body = ask(own, request(view, projection, 64, 64))
        assert (task, body) == (NO_UPDATE, b""), "the first answer has nothing yet"
        inverse, jpeg, packed = image_of(own, request(view, projection, 64, 64))
    undo = np.frombuffer(inverse, "<f4").reshape(4, 4).T.astype(float)
    assert np.allclose(undo @ projection @ view, np.eye(4), atol=1e-3)
    truth = photograph(camera)
    shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB).astype(int)
    right = truth.rgb[0].movedim(0, -1).numpy()
    assert np.abs(shown - right).mean() < 8 < np.abs(shown[::-1] - right).mean(), "upright"
    steps = np.frombuffer(zstandard.ZstdDecompressor().decompress(packed, max_output_size=64 * 64 * 2), "<i2")
    z = steps.reshape(64, 64)[::-1] / 5000
    seen = (truth.depth[0].numpy() > 0) & (z > 0)
    assert seen.sum() > 300 and (z[truth.depth[0].numpy() == 0] < 0).mean() > 0.9, "the background is dropped"
    assert np.median(np.abs(z - truth.depth[0].numpy())[seen]) < 0.03, "but for the rim, where a hull is fat"
    # As a client does: pixel and depth through the inverse, to points of the ball.
    rows, columns = np.nonzero(seen)
    ndc_z = (projection[2, 2] * -z[seen] + projection[2, 3]) / z[seen]
    clip = np.stack([2 * (columns + 0.5) / 64 - 1, 1 - 2 * (rows + 0.5) / 64, ndc_z, np.ones_like(ndc_z)])
    world = undo @ clip
    assert abs(np.median(np.linalg.norm(world[:3] / world[3], axis=0)) - 0.5) < 0.03


def test_an_answer_belongs_to_the_previous_request(served):
    views, own = [gl(camera_at(angle, "t", size=48)) for angle in (0, 120)], RiftcastClient(served[1], Limits())

    def view_of(answer):
        undo = np.frombuffer(blobs(answer[8:])[0], "<f4").reshape(4, 4).T
        return next(n for n, view in enumerate(views) if np.allclose(undo @ view[1] @ view[0], np.eye(4), atol=1e-3))

    assert struct.unpack("<HHi", own.answer(request(*views[0], 48, 48))) == (1, 3, NO_UPDATE)
    for answered, requested in ((0, 1), (1, 0)):
        wait_until(own._job.done.done)
        assert view_of(own.answer(request(*views[requested], 48, 48))) == answered
    own.leave()


def test_the_rig_is_sent_as_matrices(served):
    with client(served[0]) as own:
        task, body = ask(own, struct.pack("<HHi", 1, 3, CAMERA_DATA))
    views, projections = (np.frombuffer(part, "<f4").reshape(-1, 4, 4).swapaxes(1, 2) for part in blobs(body))
    assert task == CAMERA_DATA and len(views) == len(projections) == len(CAMERAS)
    for n in range(len(CAMERAS)):
        view, projection = gl(CAMERAS[n])
        assert np.allclose(views[n], view, atol=1e-5) and np.allclose(projections[n], projection, atol=1e-5)
        back = camera_of(views[n].astype(float), projections[n].astype(float), 48, 48)
        K = CAMERAS.K[n]
        assert np.allclose([back.fx, back.fy, back.cx, back.cy], [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], atol=1e-3)
        assert np.allclose(np.array(back.R).reshape(3, 3), CAMERAS.camera_from_world[n, :3, :3], atol=1e-5)


VIEW, PROJECTION = gl(camera_at(0, "t"))
GOOD = request(VIEW, PROJECTION, 48, 48)
BENT = np.diag([1.0, 2, 1, 1])


def is_disconnected(own, sent=b""):
    own.sendall(sent)
    with pytest.raises(OSError):
        exactly(own, 4)
    return True


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (GOOD[:5], "head"),
        (GOOD[:100], "144 bytes"),
        (request(VIEW, PROJECTION, 48, 48, major=2), "version 2"),
        (request(VIEW @ BENT, PROJECTION, 48, 48), "rotation"),
        (request(VIEW, np.eye(4), 48, 48), "perspective"),
        (request(np.full((4, 4), np.nan), PROJECTION, 48, 48), "finite"),
    ],
)
def test_a_malformed_request_ends_the_connection(served, message, said):
    with pytest.raises(ProtocolError, match=said):
        parse(message)
    with client(served[0]) as own:
        assert is_disconnected(own, framed(message))
    with client(served[0]) as own:
        assert image_of(own, GOOD)


def test_a_request_that_is_not_supported_ends_the_connection(served):
    sizes = [request(VIEW, PROJECTION, *size) for size in ((4000, 4000), (0, 48))]
    for sent in (struct.pack(">I", 1 << 30), *map(framed, (struct.pack("<HHi", 1, 3, 6), *sizes))):
        with client(served[0]) as own:
            assert is_disconnected(own, sent)


def test_silent_and_surplus_clients_are_disconnected(served, monkeypatch):
    with contextlib.ExitStack() as all_of_them:
        clients = [all_of_them.enter_context(client(served[0])) for _ in range(3)]
        assert all(ask(own, GOOD)[0] in (NO_UPDATE, UPDATE) for own in clients)
        with client(served[0]) as fourth:
            assert is_disconnected(fourth)
    wait_until(lambda: not served[1]._sessions)
    monkeypatch.setattr(riftcast_service, "SILENT_S", 0.3)
    with client(served[0]) as own:
        assert is_disconnected(own, framed(GOOD)[:24])


def test_a_port_in_use_is_an_error():
    with riftcast_extension(0).keywords["listener"] as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"port {port} of 127.0.0.1: .*choose another --riftcast-port"):
            riftcast_extension(port)


def test_the_command_serves_viewers_and_riftcast_clients(capsys):
    options = ["serve", "studio", "--port", "0", "--riftcast-port", "0", "--model", "telea", "--size", "64"]
    command = [sys.executable, "-m", "viewmend", *options, "--cameras", "4", "--frames", "1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as server:
        try:
            lines = [server.stdout.readline() for _ in range(2)]
            port = int(lines[1].rsplit(" ", 1)[1])
            assert lines[0].startswith("open http://127.0.0.1:") and "RIFTCast" in lines[1]
            with client(port) as own:
                assert ask(own, GOOD)[0] in (NO_UPDATE, UPDATE)
        finally:
            server.terminate()
    assert main([*options, "--ray", "local"]) == 2 and "--riftcast-port or --ray" in capsys.readouterr().err
