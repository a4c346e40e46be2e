"""`drive_robot`: a trained policy drives a robot over ROS 1, ROS 2 or DDS, or through a bag."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from mcaprl.drive.driver import Driver
from mcaprl.drive.loop import DriveStatus, Loop
from mcaprl.drive.transports import Transport
from mcaprl.errors import UnknownNameError, UsageError


def drive_robot(
    run: str | PathLike[str] | Driver,
    transport: str | Transport,
    *,
    bag: str | Path | None = None,
    mapping: str | Path | Mapping[str, Any] | None = None,
    enable: str | None = None,
    dry_run: bool = False,
    duration_s: float | None = None,
    deadline_s: float | None = None,
    domain_id: int | None = None,
    interface: str | None = None,
    trust_code: bool = False,
    record: str | Path | None = None,
    overwrite: bool = False,
    on_status: Callable[[DriveStatus], None] = lambda _: None,
) -> DriveStatus:
    """Drive a robot with a policy that was trained from its bag.

    Nothing is commanded before each input is there. The stop command of the mapping is published
    if an input is missing or too old, a command is late, or the drive ends for whatever reason, as
    long as the process lives; the robot itself has to stop if no commands come.

    Args:
        run: Run folder, or a `Driver`.
        transport: `dds` (needs no ROS), `ros1`, `ros2`, `bag`, or an object with the same methods.
        bag: Bag that `bag` plays, without publishing anything; for the others, a bag that has the
            topics, if the run does not contain their types.
        mapping: Mapping file that replaces that of the run; see `Driver`.
        enable: Deadman switch: topic of a Bool, or a field such as `/joy.buttons[4]`. The policy
            drives while it is true, and not older than half a second.
        dry_run: Whether to publish nothing.
        duration_s: Seconds after which the drive ends; None for no limit.
        deadline_s: Longest time in seconds from the message or the tick of a step to its command;
            later commands are replaced by the stop command. None for the period of the clock, at
            most 0.1 s.
        domain_id: Number of the DDS domain; None for ROS_DOMAIN_ID, or 0.
        interface: Network interface for DDS, such as `eth0`; None for this machine alone.
        trust_code: Whether the mapping may name a Python function.
        record: MCAP file. A drive is recorded as a log of this package, beside the robot's topics;
            see `Driver.record`. For `bag`, the file has the topics of the commands, and with the
            prefix `/mcaprl` what would have been commanded.
        overwrite: Whether an existing file is replaced.
        on_status: Function that is called four times in a second, and at the end.

    Returns:
        What the drive did.

    Raises:
        PolicyError: The run cannot drive this robot.
        UsageError: A topic has another type, an image another size, or the transport cannot be
            used.
        LogError: An input or the clock is such that waiting does not help.
        OutputExistsError: The file of `record` exists.
        KeyboardInterrupt: The process was asked to end.
    """
    if (domain_id, interface) != (None, None) and transport != "dds":
        raise UsageError("`domain_id=` and `interface=` are for `transport='dds'`")
    if record is not None and dry_run and transport != "bag":
        raise UsageError("a dry run cannot be recorded: its actions are not those of the robot")
    driver = run
    if not isinstance(driver, Driver):
        types = None if transport == "bag" and mapping is None else bag
        driver = Driver(run, mapping=mapping, bag=types, trust_code=trust_code)
    link = transport
    if isinstance(link, str):
        link = _transport(link, driver, bag, record, overwrite, domain_id, interface)
    loop = Loop(driver, link, enable=enable, dry_run=dry_run, deadline_s=deadline_s)
    if record is not None and link.encoding:
        driver.record(record, overwrite=overwrite)
    return loop.run(duration_s=duration_s, on_status=on_status)


def _transport(
    name: str,
    driver: Driver,
    bag: Any,
    record: Any,
    overwrite: bool,
    domain_id: int | None,
    interface: str | None,
) -> Transport:
    if name == "dds":
        from mcaprl.drive.transports.dds import DdsTransport

        return DdsTransport(domain_id=domain_id, interface=interface)
    if name == "bag":
        from mcaprl.drive.transports.bag import BagTransport

        if bag is None:
            raise UsageError("`transport='bag'` needs `bag=`")
        return BagTransport(
            bag, definitions=driver.mapping.definitions, record=record, overwrite=overwrite
        )
    from mcaprl.drive.transports.ros import Ros1Transport, Ros2Transport

    kinds: dict[str, type[Any]] = {"ros1": Ros1Transport, "ros2": Ros2Transport}
    if name not in kinds:
        raise UnknownNameError("transport", name, ("dds", "bag", *kinds))
    found: Transport = kinds[name]()
    return found
