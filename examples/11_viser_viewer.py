"""A viewer in viser: `pip install 'viewmend[examples]'`, then `python examples/11_viser_viewer.py [CAPTURE]`.

`viewmend serve` has a page of its own with comparison, depth and broadcast. This one shows how to put completed views
behind another viewer: viser sends its camera, and the view becomes its background.
"""

import sys
import threading

import torch
import viser

from viewmend import Cameras, Stream, Studio, StudioConfig, load_inpainter, open_capture, pinhole, prepare


def view_camera(camera: viser.CameraHandle, height: int) -> Cameras:
    """A viser client's camera; both use OpenCV's axes."""
    w, x, y, z = (float(value) for value in camera.wxyz)
    rotation = torch.tensor(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    pose = torch.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ torch.tensor(camera.position, dtype=torch.float32)
    return pinhole(float(camera.fov), round(height * float(camera.aspect)), height, pose)


def main(path: str | None = None, height: int = 256, port: int = 8080) -> viser.ViserServer:
    """Start the server, which draws a view for each client whenever its camera moves."""
    source = (
        prepare(open_capture(path)) if path else Studio(StudioConfig(cameras=8, frames=1, size_px=height))
    )
    stream = Stream(load_inpainter("views"), bounds=source.bounds)
    stream.add_frame(source.read(0))
    one_at_a_time = threading.Lock()
    server = viser.ViserServer(host="127.0.0.1", port=port)
    server.scene.set_up_direction("+y" if source.up is None else tuple(source.up.tolist()))

    @server.on_client_connect
    def connect(client: viser.ClientHandle) -> None:
        @client.camera.on_update
        def draw(camera: viser.CameraHandle) -> None:
            with one_at_a_time:
                completed = stream.view(view_camera(camera, height)).completed
            image = (completed.rgb.clamp(0, 1) * 255).byte().movedim(0, -1).numpy()
            client.scene.set_background_image(image, format="jpeg")

    return server


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None).sleep_forever()
