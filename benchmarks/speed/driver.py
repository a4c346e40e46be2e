"""Measure the CPU time of a step of `mcaprl.Driver` beside the network, on one thread.

    python -m benchmarks.speed.driver RUN BAG [--record drive.mcap]

RUN was trained from BAG. All messages are decoded before; the time has all calls of `push` and
`command`, without the policy, and with `--record` without writing at the end. For the car of
`examples/05_robot_bag`: ten quantities of four topics, and about 26 messages a step.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import torch

import mcaprl


def main() -> None:
    """Read the command line, and print the times."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run")
    parser.add_argument("bag")
    parser.add_argument("--record", type=Path, help="also write the log of the drive")
    given = parser.parse_args()
    torch.set_num_threads(1)
    driver = mcaprl.Driver(given.run)
    network_s = 0.0
    act = driver.policy.act

    def timed(observations: Any) -> Any:
        nonlocal network_s
        start_s = time.process_time()
        found = act(observations)
        network_s += time.process_time() - start_s
        return found

    object.__setattr__(driver.policy, "act", timed)
    with mcaprl.open_bag(given.bag) as bag:
        messages = sorted(bag.messages(list(driver.inputs)), key=lambda each: each.log_time_ns)
    if given.record:
        driver.record(given.record, overwrite=True)
    steps, start_s = 0, time.process_time()
    for topic, time_ns, publish_ns, message in messages:
        while driver.period_ns and (next_ns := driver.next_step_ns) and next_ns < time_ns:
            driver.command(next_ns)
            steps += 1
        driver.push(topic, message, time_ns, publish_ns)
        if topic == driver.clock_topic:
            driver.command(time_ns)
            steps += 1
    all_s = time.process_time() - start_s
    driver.close()
    own_ms, policy_ms = 1e3 * (all_s - network_s) / steps, 1e3 * network_s / steps
    per_step = len(messages) / steps
    print(f"{steps} steps, {per_step:.1f} messages a step: {own_ms:.3f} ms CPU a step beside the")
    print(f"network, which takes {policy_ms:.3f} ms")


if __name__ == "__main__":
    main()
