"""Help texts of the program: groups of commands, groups of options, examples, and exit codes.

docs/cli.md lists the exit codes.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, Final

import click

from mcaprl._interrupt import INTERRUPTED
from mcaprl.cli.progress import quiet_option
from mcaprl.errors import McaprlError, UsageError

WITH_LOSSES: Final = 3  # Exit code of `recover` if data is lost

EXIT_CODES: Final[dict[int, str]] = {
    0: "Success.",
    McaprlError.exit_code: (
        "A log, policy, run or other file cannot be read, written or used. Also: `check`,"
        " `info --strict` or `replay --verify` found a problem, and `recover` can keep nothing."
    ),
    UsageError.exit_code: (
        "The request is invalid: an unknown command, option, name or policy, a value out of range,"
        " options that exclude each other, an output that exists, or a package that is not"
        " installed."
    ),
    WITH_LOSSES: "`recover` wrote a log, but some data is lost.",
    INTERRUPTED: (
        "The command was interrupted by Ctrl-C, SIGTERM or SIGHUP. The last line says what is kept."
    ),
}
"""Meaning of each exit code."""


SECTIONS: Final[dict[str, tuple[str, ...]]] = {
    "Record and learn": ("record", "train-online", "train-offline", "evaluate", "export"),
    "Drive a robot": ("drive",),
    "Look at logs": ("info", "replay", "layout", "annotate"),
    "Check and repair logs": ("check", "recover"),
    "Convert and edit logs": ("convert", "merge", "split", "filter", "slice", "relabel", "label"),
    "Set up the shell": ("completion",),
}
"""Commands in the order of the program's help."""

EXAMPLES: Final[dict[str, tuple[str, ...]]] = {
    "record": (
        "mcaprl record lane --policy pilot --epsilon 0.1 --episodes 25 --out data/pilot.mcap",
        "mcaprl record CartPole-v1 --policy random --episodes 10 --out cartpole.mcap",
        "mcaprl record lane --policy runs/cql --episodes 3 --camera --out replay.mcap",
    ),
    "train-online": (
        "mcaprl train-online lane --steps 80000 --out runs/online",
        "mcaprl train-online lane --record online.mcap --out runs/recorded",
        "mcaprl train-online CartPole-v1 --algo ppo --out runs/ppo",
    ),
    "train-offline": (
        "mcaprl train-offline data --algo cql --seeds 2 --out runs/cql",
        "mcaprl train-offline data/pilot.mcap:2 data/random.mcap --algo iql --out runs/iql",
        "mcaprl train-offline data --algo auto --budget-minutes 20 --out runs/auto --report page",
        "mcaprl train-offline data --resume --out runs/cql",
    ),
    "evaluate": (
        "mcaprl evaluate runs/cql pilot random --sim lane --behavior data --report report",
        "mcaprl evaluate runs/cql --data data",
    ),
    "drive": (
        "mcaprl drive runs/robot --bag bag",
        "mcaprl drive runs/robot --dds --dry-run",
        "mcaprl drive runs/robot --ros2 --enable /joy.buttons[4]",
    ),
    "export": ("mcaprl export runs/cql --out policy.onnx",),
    "info": ("mcaprl info data", "mcaprl info data/pilot.mcap --report report"),
    "replay": (
        "mcaprl replay replay.mcap",
        "mcaprl replay replay.mcap --browser",
        "mcaprl replay replay.mcap --episode 0 --save episode.html",
        "mcaprl replay replay.mcap --episode 0 --video episode.mp4",
        "mcaprl replay replay.mcap --verify",
    ),
    "layout": ("mcaprl layout replay.mcap --out foxglove-layout.json",),
    "annotate": ("mcaprl annotate replay.mcap --policy runs/cql --out annotated.mcap",),
    "check": ("mcaprl check data/pilot.mcap",),
    "recover": ("mcaprl recover damaged.mcap recovered.mcap",),
    "convert": (
        "mcaprl convert data/pilot.mcap pilot.parquet --to parquet",
        "mcaprl convert --suggest bag > robot.yaml",
        "mcaprl convert bag robot.mcap --mapping robot.yaml",
    ),
    "merge": ("mcaprl merge data/pilot.mcap data/random.mcap all.mcap --shift",),
    "split": ("mcaprl split all.mcap parts --ratio 8:1:1 --seed 0",),
    "filter": ("mcaprl filter 'total_reward > 100' data/pilot.mcap good.mcap",),
    "slice": ("mcaprl slice data/pilot.mcap part.mcap --steps 0:1000",),
    "relabel": ("mcaprl relabel data/pilot.mcap faster.mcap --reward 'reward + 0.1 * speed'",),
    "label": (
        "mcaprl label data/pilot.mcap --episode 3 --failure --note 'hit the wall'",
        "mcaprl label data/pilot.mcap --episode 3 --interval intervention --steps 40:60",
        "mcaprl label robot.bag --mapping robot.yaml --episode 3 --success",
    ),
    "completion": (
        "mcaprl completion bash >> ~/.bashrc",
        "mcaprl completion fish > ~/.config/fish/completions/mcaprl.fish",
    ),
}
"""Examples of each command, shown at the end of its help."""

_BAGS: Final[dict[str, tuple[str, ...]]] = {
    "Bags of other robots": ("mapping", "definitions", "strict_mapping", "trust_code")
}
_RAY: Final[dict[str, tuple[str, ...]]] = {"Ray cluster": ("ray", "workers", "address")}
OPTION_GROUPS: Final[dict[str, dict[str, tuple[str, ...]]]] = {
    "label": {"Intervals": ("interval", "steps", "time"), **_BAGS},
    "record": {
        "Policy and length": (
            "policy",
            "epsilon",
            "noise",
            "noise_per_episode",
            "episodes",
            "steps",
            "max_steps",
            "seed",
            "envs",
        ),
        "Sim": ("observation", "rules", "actions", "sim_options", "trust_env"),
        "Log": ("out", "no_scene", "camera", "infos", "keys", "compression"),
        "Files": ("overwrite", "append", "rotate_mb", "upload"),
        "Ray cluster": ("ray", "workers", "address", "shards"),
    },
    "train-online": {
        "Run": ("out", "algo", "preset", "seeds", "seed", "threads", "device", "sources", "resume"),
        "Sim": ("observation", "rules", "actions", "sim_options", "max_steps"),
        "Log": ("record", "upload"),
        "Live view": ("live", "live_speed", "port", "allow_origin"),
    },
    "train-offline": {
        "Run": ("out", "algo", "seeds", "seed", "threads", "device", "resume"),
        "Data": ("follow", "other_data", "only", "mask"),
        **_BAGS,
    },
    "evaluate": {
        "Episodes in a sim": ("sim", "episodes", "max_steps", "seed", "behavior"),
        "Arguments of the sim": ("observation", "rules", "actions", "sim_options", "trust_env"),
        "Estimates from logs": (
            "data",
            "gamma",
            "epsilon",
            "updates",
            "estimate_behavior",
            "clip_actions",
            "threads",
            "only",
            "mask",
        ),
        "Output with --sim": ("record", "keys", "report", "overwrite"),
        "Output": ("as_json",),
        **_BAGS,
        **_RAY,
    },
    "drive": {
        "Way to the robot": ("dds", "ros1", "ros2", "bag", "domain_id", "interface"),
        "When it drives": ("enable", "dry_run", "duration_s", "deadline_s"),
        "Log": ("record", "overwrite"),
        "Mapping": ("mapping", "trust_code"),
    },
    "info": {"Bags of other robots": ("mapping", "definitions", "trust_code")},
    "check": _BAGS,
    "annotate": {
        "Values": ("policy", "gamma"),
        "Scene": ("scene", "camera", "sim", "sim_options", "trust_env"),
        "Output": ("out", "overwrite"),
        **_BAGS,
    },
    "replay": {
        "Playback": ("browser", "episode", "speed", "loop", "port", "allow_origin"),
        "Comparison with the sim": ("verifies", "sim", "sim_options", "trust_env"),
        "Page, video and image": ("save", "video", "contact_sheet", "height", "overwrite"),
    },
    "convert": {
        "Formats": ("source_format", "one_episode", "dones", "to", "lossy"),
        "Bags of other robots": (
            "mapping",
            "definitions",
            "strict_mapping",
            "trust_code",
            "suggest",
        ),
        "Output": ("dry_run", "overwrite", "upload", "as_json"),
    },
}
"""Groups of options in the help of each command, by the options' names in Python; the other options
are in the group `Options`."""


class Command(click.Command):
    """Command whose options are listed in groups, and which has the option `--quiet`."""

    def __init__(self, *arguments: Any, **others: Any) -> None:
        """Create the command, as `click.Command` does."""
        super().__init__(*arguments, **others)
        self.params.append(quiet_option())

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options in their groups."""
        self.write_options(ctx, formatter, self.get_params(ctx))

    def write_options(
        self, ctx: click.Context, formatter: click.HelpFormatter, params: Iterable[click.Parameter]
    ) -> None:
        """Write options in the groups of this command."""
        options = {param.name: param for param in params if isinstance(param, click.Option)}
        groups = OPTION_GROUPS.get(self.name or "", {})
        for title, names in groups.items():
            self.write_group(ctx, formatter, title, [options.pop(n) for n in names if n in options])
        self.write_group(ctx, formatter, "Options", options.values())

    def write_group(
        self,
        ctx: click.Context,
        formatter: click.HelpFormatter,
        title: str,
        options: Iterable[click.Option],
    ) -> None:
        """Write one group of options without its hidden options."""
        records = [record for option in options if (record := option.get_help_record(ctx))]
        if records:
            with formatter.section(title):
                formatter.write_dl(records)


class Program(click.Group):
    """Group of commands whose help has sections, and whose commands have examples."""

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, with its examples as the end of its help."""
        super().add_command(cmd, name)
        lines = EXAMPLES.get(name or cmd.name or "", ())
        if lines:
            # A line with only \\b keeps the following lines as they are.
            cmd.epilog = "\n".join(["\b", "Examples:", *(f"  {line}" for line in lines)])

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command; if there is none, suggest those with similar names."""
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            names = self.list_commands(ctx)
            near = [name for name in names if name.startswith(args[0])]
            near = near or difflib.get_close_matches(args[0], names)
            if near:
                ctx.fail(f"No such command '{args[0]}': did you mean {' or '.join(near)}?")
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the commands in the order of `SECTIONS`."""
        known = [name for names in SECTIONS.values() for name in names]
        return [*known, *(name for name in super().list_commands(ctx) if name not in known)]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write one section for each group of commands."""
        for title, names in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name, self._summary(ctx, name)) for name in names])

    def _summary(self, ctx: click.Context, name: str) -> str:
        command = self.get_command(ctx, name)
        assert command is not None
        return command.get_short_help_str(limit=1_000)
