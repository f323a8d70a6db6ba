"""/metrics: counters and gauges as Prometheus reads them."""

from collections.abc import Mapping

from viewmend.live.connection import SessionRegistry
from viewmend.live.memory import resident_bytes


def metrics_text(registry: SessionRegistry) -> str:
    """Everything that is counted."""
    service = registry.service
    counts = dict(service.counts)
    dropped = sum(session.dropped for session in list(registry.sessions))
    ready = int(service.ready and service.supply.status.state == "ready")
    lines = [
        *_metric("viewmend_up", "gauge", "1 while views can be rendered.", {"": ready}),
        *_metric("viewmend_viewers", "gauge", "Viewers connected.", {"": len(registry.sessions)}),
        *_metric("viewmend_frames_total", "counter", "Views rendered.", {"": counts["frames"]}),
        *_metric("viewmend_shared_total", "counter", "Views of an already known time.", {"": counts["shared"]}),
        *_metric("viewmend_dropped", "gauge", "Looks of present viewers replaced before rendered.", {"": dropped}),
        *_metric("viewmend_errors_total", "counter", "Views that failed.", {"": counts["errors"]}),
        *_metric("viewmend_source_frames", "gauge", "Frames that can be asked for.", {"": service.supply.span.end}),
        *_metric(
            "viewmend_stage_seconds_total",
            "counter",
            "Seconds spent in each stage.",
            {f'{{stage="{stage}"}}': ms / 1000 for stage, ms in vars(service.times).items() if stage != "wait"},
        ),
    ]
    if (broadcast := registry.broadcast) is not None:
        lines += _metric("viewmend_broadcast_watched", "gauge", "1 while it is watched.", {"": int(broadcast.watched)})
        sent = {_of(kind=kind): broadcast.counts[kind] for kind in ("playlists", "segments")}
        lines += _metric("viewmend_broadcast_files_total", "counter", "Files of the film that were sent.", sent)
        size = {"": broadcast.counts["bytes"]}
        lines += _metric("viewmend_broadcast_bytes_total", "counter", "Bytes of the film that were sent.", size)
    cameras = service.supply.camera_counts()
    if cameras:
        up = {_of(camera=name): counts["up"] for name, counts in cameras.items()}
        pictures = {
            _of(camera=name, event=event): count
            for name, counts in cameras.items()
            for event, count in counts.items()
            if event != "up"
        }
        lines += _metric("viewmend_camera_up", "gauge", "1 while the camera's pictures come.", up)
        lines += _metric(
            "viewmend_camera_pictures_total", "counter", "What became of each camera's pictures.", pictures
        )
    if (spread_ms := service.supply.spread_ms) is not None:
        help_text = "How far apart the newest frame's pictures were taken."
        lines += _metric("viewmend_cameras_apart_seconds", "gauge", help_text, {"": spread_ms / 1000})
    resident = resident_bytes()
    if resident is not None:
        lines += _metric("process_resident_memory_bytes", "gauge", "Resident memory size in bytes.", {"": resident})
    return "\n".join(lines) + "\n"


def _of(**labels: str) -> str:
    """Labels as Prometheus writes them."""
    escaped = ((key, value.replace("\\", "\\\\").replace('"', '\\"')) for key, value in labels.items())
    return "{" + ",".join(f'{key}="{value!s}"' for key, value in escaped).replace("\n", "\\n") + "}"


def _metric(name: str, kind: str, text: str, values: Mapping[str, float | int]) -> list[str]:
    rows = [f"{name}{labels} {value!r}" for labels, value in values.items()]
    return [f"# HELP {name} {text}", f"# TYPE {name} {kind}", *rows]
