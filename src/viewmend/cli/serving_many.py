"""`viewmend serve --ray`: one process reads the rig, many render."""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn

from viewmend.cli.console import say
from viewmend.cli.serve import Options, load_inpainter, open_supply, server_config, stream_config
from viewmend.cli.signals import ended_by_sigterm


def serve_many(options: Options) -> NoReturn:
    """Serve on a Ray cluster until interrupted.

    Raises:
        ValueError: Ray or the cluster is not there, the source cannot be read, or it is a rig that pushes.
    """
    assert options.ray is not None, "--ray was given"
    if options.source == "live":
        raise ValueError(
            "expected a capture, rig.toml or studio with --ray, got live: a rig that pushes would reach one replica "
            "of many; leave --ray away, or name the rig's cameras in a file (docs/guide/live-rig.md)"
        )
    from viewmend.live.guard import Guard, is_loopback
    from viewmend.live.protocol import token_query
    from viewmend.live.replicas import ManyViewers, serving

    config = server_config(options)
    Guard(config.host, config.token)
    if not is_loopback(config.host):
        say("Serve's proxy does not bound what strangers may cost (docs/live.md); put a proxy that does before it")
    found = replace(
        options,
        source=_absolute(options.source),
        model=None if options.model is None else _absolute(options.model),
        error_rule=None if options.error_rule is None else _absolute(options.error_rule),
    )
    served = ManyViewers(
        open_supply=partial(open_supply, found),
        load_inpainter=partial(load_inpainter, found),
        server=config,
        stream=stream_config(found),
        device=options.device,
        replicas=(options.replicas, options.most_replicas or options.replicas),
        store_mb=options.memory_mb / 2,
    )
    with serving(served, options.ray) as address, ended_by_sigterm():  # Ray has a handler of its own
        say(f"open {address}/{token_query(config.token)}   (Ctrl-C stops it)")
        while True:  # the system may give a signal to any thread, and this one must see it
            time.sleep(0.5)


def _absolute(name: str) -> str:
    """A file's or folder's whole path, which other processes and machines find, too; any other name as it is."""
    path, colon, what = name.rpartition(":")
    if colon and Path(path).is_file():
        return f"{Path(path).resolve()}:{what}"
    return str(Path(name).resolve()) if Path(name).exists() else name
