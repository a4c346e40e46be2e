"""Make a robot's bag from the drives in a log of the lane sim.

    mcaprl record lane --actions continuous --noise 0.1 --noise-per-episode --out native.mcap
    python examples/05_robot_bag/make_bag.py native.mcap bag                  # ROS 2, by rosbags
    python examples/05_robot_bag/make_bag.py native.mcap drive.mcap --format protobuf

Only the seeds and actions are read from the log; `robot.py` lists the topics of the bag.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from robot import PAUSE_S, Drive, Message
from writers import WRITERS

import mcaprl
from mcaprl.progress import terminal_bar
from mcaprl.sims import CarCamera

START_NS = 1_700_000_000 * 10**9


def make_bag(log: str | Path, out: str | Path, form: str = "ros2") -> int:
    """Write the drives of a log of the lane sim as a bag; return the number of messages.

    `out` is the folder of a ROS 2 bag, or an MCAP file; `form` is `ros2`, `protobuf` or `json`.
    """
    with WRITERS[form](Path(out)) as write:
        messages = [write(one.topic, at_ns, one.content) for at_ns, one in _recorded(log)]
    return len(messages)


def _recorded(log: str | Path) -> Iterator[tuple[int, Message]]:
    data, camera, start_ns = mcaprl.open(log), CarCamera(), START_NS
    env = mcaprl.make_sim("lane", **data.env_kwargs)
    with terminal_bar("driving", len(data.episodes)) as advance:
        for episode in data.episodes:
            assert episode.seed is not None, f"{log} has no seeds"
            drive = Drive(env, episode.seed, episode.actions)
            for message in drive.messages(camera, start_ns):
                yield start_ns + round(message.time_s * 1e9), message
            start_ns += round((drive.duration_s + PAUSE_S) * 1e9)
            advance(1)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("log", type=Path, help="log of the lane sim")
    parser.add_argument("out", type=Path, help="folder of a ROS 2 bag, or MCAP file")
    parser.add_argument("--format", choices=list(WRITERS), default="ros2")
    given = parser.parse_args()
    print(f"{given.out}: {make_bag(given.log, given.out, given.format)} messages")


if __name__ == "__main__":
    main()
