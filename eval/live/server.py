"""A rosbridge of one's own: the simulated robot behind a websocket that speaks the rosbridge protocol.

    python -m eval.live.server --port 9090     # then: potlp drive localhost --task '!fire U exit' ...
    python -m eval.live.server --environment map:FILE.yaml     # in a building, with a camera; prints how to drive there

Only what ``potlp drive`` uses is spoken: subscribe, advertise, publish, and the goals of actions.
"""

import argparse
import json
import sys
import threading
import time
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from eval.live.building import REACH, Building
from eval.live.perturbation import Network, Perturbation
from eval.live.simulator import FLOOR, PICTURES, STEP, Behaviour, Ground, SimulatedLink
from potlp_jax.cache import enable_compilation_cache
from potlp_jax.errors import PotlpError

_SUCCEEDED, _CANCELED, _ABORTED = 4, 5, 6
"""Of action_msgs/GoalStatus."""


class RosbridgeServer:
    """Serves one robot to whoever connects. ``speed``: seconds of the simulation in one of the clock."""

    def __init__(self, behaviour: Behaviour, port: int = 0, speed: float = 1.0, ground: Ground = FLOOR) -> None:
        network = Network(Perturbation(), np.random.default_rng(0))
        self.link = SimulatedLink(ground, behaviour, network)
        self.advertised: dict[str, str] = {}
        self._speed, self._lock, self._closed = speed, threading.Lock(), threading.Event()
        self._names: dict[str, str] = {}
        self._server: Server = serve(self._talk, "127.0.0.1", port, max_size=None)
        self.port: int = self._server.socket.getsockname()[1]
        for target in (self._server.serve_forever, self._pass_time):
            threading.Thread(target=target, daemon=True).start()

    def close(self) -> None:
        """End it, as a robot whose network is gone."""
        self._closed.set()
        self._server.shutdown()

    def _pass_time(self) -> None:
        while not self._closed.is_set():
            time.sleep(STEP / self._speed)
            with self._lock:
                self.link.step(STEP)

    def _talk(self, connection: ServerConnection) -> None:
        try:
            for text in connection:
                with self._lock:
                    self._take(json.loads(text), connection)
        except ConnectionClosed:
            return

    def _take(self, message: dict[str, Any], connection: ServerConnection) -> None:
        operation = message["op"]
        if operation == "subscribe":
            topic = message["topic"]
            self.link.subscribe(
                topic, message["type"], lambda found: _send(connection, {"op": "publish", "topic": topic, "msg": found})
            )
        elif operation == "advertise":
            self.advertised[message["topic"]] = message["type"]
        elif operation == "publish":
            self.link.publish(message["topic"], self.advertised[message["topic"]], message["msg"])
        elif operation == "send_action_goal":
            self._begin(message, connection)
        elif operation == "cancel_action_goal":
            self.link.cancel(message["action"], self._names[message["id"]])

    def _begin(self, message: dict[str, Any], connection: ServerConnection) -> None:
        def done(succeeded: bool, words: str) -> None:
            status = _SUCCEEDED if succeeded else _CANCELED if words == "canceled" else _ABORTED
            result = {"op": "action_result", "id": message["id"], "action": message["action"], "values": {}}
            _send(connection, {**result, "status": status, "result": succeeded})

        name = self.link.send_goal(message["action"], message["action_type"], message["args"], done)
        self._names[message["id"]] = name


def _send(connection: ServerConnection, message: dict[str, Any]) -> None:
    try:
        connection.send(json.dumps(message))
    except ConnectionClosed:
        # Whoever has left hears nothing.
        return


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m eval.live.server", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--port", type=int, default=9090)
    parser.add_argument("--speed", type=float, default=1.0, help="seconds of the simulation in a second")
    parser.add_argument(
        "--environment", help="map:FILE.yaml or parcels:FILE.yaml, a map of yours; default: two rooms of text"
    )
    parser.add_argument("--world", type=int, default=0, help="number of the building's test world")
    arguments = parser.parse_args()
    enable_compilation_cache()
    ground, behaviour = FLOOR, Behaviour()
    if arguments.environment is not None:
        try:
            ground = Building.from_spec(arguments.environment, arguments.world)
        except PotlpError as error:
            sys.exit(f"{parser.prog}: {error}")
        behaviour = Behaviour(pixels=1, reach=REACH)
    server = RosbridgeServer(behaviour, arguments.port, arguments.speed, ground)
    names = ",".join(ground.propositions)
    print(f"rosbridge at localhost:{server.port}; propositions {names}; Ctrl-C ends it", flush=True)
    if isinstance(ground, Building):
        # Its walls have grown by the radius that the map was cleaned with.
        options = f"--propositions {names} --resolution {ground.frame.resolution:g} --radius 0 --image-topic {PICTURES}"
        print(f"next: potlp drive localhost:{server.port} {options} --follow --task FORMULA --out FOLDER", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
