"""Foxglove layout of a log, with the screens Drive, Learning and Data.

The classic form (`configById`, `layout`, `globalVariables`, `userNodes`, `playbackConfig`) opens in
Foxglove and in Lichtblick. The screens are the tabs of one panel. Each screen has few panels, so
that it fits into a window of 1280 x 720 pixels.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gymnasium import spaces

from mcaprl.recorder.format.messages import INTERRUPTED
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.schema import (
    EPISODE_TOPIC,
    IMAGE_FRAME,
    LOG_TOPIC,
    RETURN_SO_FAR,
    STEP_TOPIC,
)
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.record import panels
from mcaprl.recorder.record.camera import VIDEO
from mcaprl.recorder.record.panels import Node, Panel

LAYOUT_NAME = "foxglove-layout.json"
VALUES_TOPIC = "/rl/values"
TRAINING_TOPIC = "/rl/training"
_SCENE, _STATIC, _TRACKS, _DEPTH = "/scene", "/scene/static", "/scene/tracks", "/camera/depth"
_MAP = "/scene/map"
_WORLD = "map"
_STILL = (_WORLD, "follow-none")
_NONE: Sequence[str] = ()
_SPEED = "speed_m_s"
# Suffixes of the telemetry names in the first plot. The speed is shown by a gauge instead.
_WATCHED = ("offset_m", "steering_rad", "distance_m")
_MOST_DIALS = 4
# Values for environments without `view_settings`.
CAMERA_M, TILT_DEG, AROUND_M, DEPTH_M, _HIGHEST_M_S = 22.0, 73.0, 100.0, (0.0, 50.0), 30.0
# Length of the vehicle's axes in the view from above of a log without /scene/map, as a share of
# the visible height.
_MARK = 0.03
# End reasons of failures, from the sims and from Gymnasium. The indicator shows their names.
_REASONS = (
    *("off_lane", "off_line", "collision", "crash", "stall", "no_gate", "slow", "low_reward"),
    *("terminated", "time_limit"),
)
_IMAGES = ("Image", "RawImage", "CompressedImage", "CompressedVideo")
_SPATIAL = (
    *("LaserScan", "PointCloud2", "PointCloud", "OccupancyGrid", "Grid", "MarkerArray", "Marker"),
    *(
        "SceneUpdate",
        "Path",
        "PoseStamped",
        "PoseWithCovarianceStamped",
        "PoseArray",
        "PoseInFrame",
    ),
)
_TRANSFORMS = ("TFMessage", "FrameTransform", "FrameTransforms", "TransformStamped")
_MOST_CAMERAS = 3
_LAST_STEPS = 80
_SHOWN_STEPS = 4
_RUNNING = {"episode": f"{panels.STEPS}.episode", "step": f"{panels.STEPS}.step"}
_MAX_EPISODE = 100
_MEAN_RETURN = "mean_return"
_FIRST_METRICS = (_MEAN_RETURN, "score")
_NEXT_METRICS = ("loss", "epsilon")
# Share of the range of the depth below the nearest one, in which the colors are almost black.
_DARK = 0.1


def layout_of(
    metadata: LogMetadata,
    topics: Sequence[str],
    telemetry_names: Sequence[str] = (),
    follow_frame: str = "",
    training: Mapping[str, str] | None = None,
    without_q: Collection[str] = (),
    episodes: int = 0,
    sensors: Mapping[str, str] | None = None,
    agreement: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return the layout for a log with these topics."""
    # `training`: titles of live metrics by field. `sensors`: types of a robot's topics by name.
    # `agreement`: share of the steps at which a policy takes the logged action, by its topic.
    # A policy with Q-values is shown first.
    ordered = sorted(topics, key=lambda topic: (is_values_topic(topic), topic in without_q))
    found = (metadata, ordered, telemetry_names, follow_frame, training or {}, without_q, episodes)
    screens = _Screens(*found, sensors or {}, agreement or {})
    nodes = {"Drive": screens.drive(), "Learning": screens.learning(), "Data": screens.data()}
    return {
        "configById": {"Tab!screens": panels.tabs(nodes), **screens.found},
        "globalVariables": {panels.EPISODE_VARIABLE: 0},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!screens",
    }


def layout_bytes(layout: dict[str, Any]) -> bytes:
    """Return a layout as JSON without spaces, because attachments are not compressed."""
    return json.dumps(layout, separators=(",", ":")).encode()


def is_values_topic(topic: str) -> bool:
    """Return whether a topic contains the outputs of a policy at each step, such as Q-values."""
    return topic == VALUES_TOPIC or topic.startswith(f"{VALUES_TOPIC}/")


@dataclass
class _Screens:
    """The screens of a layout. Each method returns a node and adds its panels to `found`."""

    metadata: LogMetadata
    topics: Sequence[str]
    telemetry: Sequence[str]
    follow_frame: str
    training: Mapping[str, str]
    without_q: Collection[str]
    episodes: int
    sensors: Mapping[str, str]
    agreement: Mapping[str, float]
    found: dict[str, Panel] = field(default_factory=dict)

    def drive(self) -> Node:
        """Return views of the scene and instruments, for watching the vehicle while it drives."""
        views = self._images()
        beside = self._instruments(is_wide=not views and _SCENE not in self.topics)
        if _SCENE not in self.topics:
            if not views:
                return beside
            return panels.split(panels.stack(views, "column"), beside, "row", 50)
        # The view from above is wider than each image, because images are square.
        below = [(view, 0.4) for view in views] + [(self._above(), 0.6)]
        if _TRACKS not in self.topics and "/tf" in self.topics and "y_m" in self.telemetry:
            below.append((self._track_so_far(), 0.4))
        left = panels.split(self._scene(), panels.weighted(below, "row"), "column", 62)
        return panels.split(left, beside, "row", 60)

    def learning(self) -> Node:
        """Return panels of training metrics or episode returns, and of the outputs of policies."""
        rows = self._metrics() if self.training else self._returns()
        if LOG_TOPIC in self.topics:
            rows.append((self._put("RosOut!learning", panels.log_lines(LOG_TOPIC)), 0.25))
        values = self._values_topics()
        nodes = {topic.removeprefix("/rl/"): self._policy(topic) for topic in values}
        left = panels.weighted(rows, "column")
        if not nodes:
            return left
        right = next(iter(nodes.values()))
        if len(nodes) > 1:
            right = self._put("Tab!policies", panels.tabs(nodes))
        return panels.split(left, right, "row", 42)

    def data(self) -> Node:
        """Return raw messages, plots of all numbers of the log, and the log lines."""
        raw = [
            (self._put(f"RawMessages!{topic[4:]}", panels.raw_messages(topic)), weight)
            for topic, weight in ((STEP_TOPIC, 0.6), (EPISODE_TOPIC, 0.4))
        ]
        others = [name for name in self.telemetry if name != RETURN_SO_FAR]
        numbers = {
            **panels.observation_groups(self.metadata),
            "actions": panels.action_series(self.metadata),
            **panels.telemetry_groups(others),
        }
        shown = {title: paths for title, paths in numbers.items() if paths}
        plots: dict[str, Node] = {title: self._plot(title, title, shown[title]) for title in shown}
        rows: list[tuple[Node, float]] = [(self._chosen_episode(), 0.27)]
        if plots:
            rows.insert(0, (self._put("Tab!numbers", panels.tabs(plots)), 0.45))
        if LOG_TOPIC in self.topics:
            rows.append((self._put("RosOut!log", panels.log_lines(LOG_TOPIC)), 0.28))
        left, right = panels.weighted(raw, "column"), panels.weighted(rows, "column")
        return panels.split(left, right, "row", 30)

    def _put(self, name: str, panel: Panel) -> str:
        self.found[name] = panel
        return name

    def _plot(self, name: str, title: str, paths: Mapping[str, str]) -> str:
        return self._put(f"Plot!{name}", panels.plot(title, paths))

    def _values_topics(self) -> list[str]:
        return [topic for topic in self.topics if is_values_topic(topic)]

    def _scene(self) -> Node:
        view = self.metadata.view
        camera = {
            "perspective": True,
            "distance": view.get("distance_m", CAMERA_M),
            "phi": view.get("tilt_deg", TILT_DEG),
            "targetOffset": [4, 0, 0],
        }
        followed = (self.follow_frame, "follow-pose") if self.follow_frame else _STILL
        shown = dict.fromkeys(self._of(_SCENE, _STATIC), _NONE)
        return self._put("3D!scene", panels.three_d("scene", shown, camera, followed))

    def _above(self) -> Node:
        """Add the view from above: of the world if its size is known, else the surroundings."""
        view = self.metadata.view
        height_m = view.get("world_m", AROUND_M)
        camera = {
            "perspective": False,
            "distance": height_m,
            "phi": 0,
            "thetaOffset": view.get("world_turn_deg", 0),
            "targetOffset": [view.get("world_x_m", 0), view.get("world_y_m", 0), 0],
        }
        follows = self.follow_frame and "world_m" not in view
        followed = (self.follow_frame, "follow-position") if follows else _STILL
        shown = dict.fromkeys(self._of(_STATIC, _TRACKS, _MAP), _NONE)
        title = "from above; tracks: yellow is best, red marks are failures"
        panel = panels.three_d(
            title if _TRACKS in shown else "from above",
            {_SCENE: ["speed"], **shown},
            camera,
            followed,
            # The vehicle is too small to see, so an arrow of the map or larger axes mark it.
            axes_m=0.0 if _MAP in shown else _MARK * height_m,
            without_axes=(_WORLD, IMAGE_FRAME),
        )
        return self._put("3D!above", panel)

    def _track_so_far(self) -> Node:
        x_path = "/tf.transforms[0].transform.translation.x"
        panel = panels.curve("track, y over x in m", x_path, "/telemetry.y_m")
        return self._put("Plot!track", panel)

    def _of(self, *topics: str) -> list[str]:
        return [topic for topic in topics if topic in self.topics]

    def _images(self) -> list[Node]:
        """Add the depth camera and the image observations."""
        names: list[Node] = []
        if _DEPTH in self.topics:
            low = self.metadata.view.get("depth_min_m", DEPTH_M[0])
            high = self.metadata.view.get("depth_max_m", DEPTH_M[1])
            colors = {"colorMode": "colormap", "colorMap": "turbo"}
            # The lowest colors are almost black, like pixels without a depth.
            nearest = max(0.0, low - _DARK * (high - low))
            limits_mm = {"minValue": 1000 * nearest, "maxValue": 1000 * high}
            title = f"depth {low:g}-{high:g} m, black: none"
            panel = panels.image(title, _DEPTH, **colors, **limits_mm)
            names.append(self._put("Image!depth", panel))
        if VIDEO in self.topics:
            names.append(self._put("Image!rendered", panels.image("rendered", VIDEO)))
        for leaf in observation_leaves(self.metadata.observation_space):
            if leaf.encoding is not None:
                panel = panels.image(f"observation: {leaf.name}", leaf.topic)
                names.append(self._put(f"Image!{leaf.name}", panel))
        own = self._of(VIDEO, _DEPTH)
        for topic in [each for each in self._sensors(_IMAGES) if each not in own][:_MOST_CAMERAS]:
            names.append(self._put(f"Image!{topic}", panels.image(topic, topic)))
        return names if _SCENE in self.topics else names + self._robot()

    def _robot(self) -> list[Node]:
        """Add what a robot's own topics show: its surroundings from above, and its odometry."""
        names: list[Node] = []
        spatial = self._sensors(_SPATIAL)
        if spatial or self._sensors(_TRANSFORMS):
            shown = dict.fromkeys(spatial, _NONE)
            camera = {"perspective": False, "distance": AROUND_M / 4, "phi": 0}
            followed = (self.follow_frame, "follow-position") if self.follow_frame else _STILL
            names.append(self._put("3D!robot", panels.three_d("robot", shown, camera, followed)))
        # 3D panels draw no odometry.
        for topic in self._sensors(("Odometry",))[:1]:
            paths = {axis: f"{topic}.pose.pose.position.{axis}" for axis in "xy"}
            names.append(self._plot(topic, f"{topic}: position in m", paths))
        return names

    def _sensors(self, kinds: Sequence[str]) -> list[str]:
        """Return the robot's topics with messages of these kinds, of any package."""
        last = {topic: re.split(r"[/.]", kind)[-1] for topic, kind in self.sensors.items()}
        return [topic for topic, kind in sorted(last.items()) if kind in kinds]

    def _instruments(self, is_wide: bool) -> Node:
        """Add the gauge, the indicator, plots of reward, return and telemetry, and the actions.

        In a wide area without a gauge, the indicator is a narrow strip.
        """
        lights = [*self._gauge(), *self._indicator()]
        returns = {"return of each episode": f"{EPISODE_TOPIC}.total_reward"}
        if RETURN_SO_FAR in self.telemetry:
            returns = {"return so far": f"/telemetry.{RETURN_SO_FAR}"}
        if _MEAN_RETURN in self.training:
            # Viewers keep live data of the panels on the screen alone.
            returns = {self.training[_MEAN_RETURN]: f"{TRAINING_TOPIC}.{_MEAN_RETURN}"}
        # As a line, rewards of 0 and 1 fill the plot of a long log.
        reward = panels.points(panels.plot("reward", {"reward": f"{panels.STEPS}.reward"}), 2)
        plots: list[Node] = [
            self._put("Plot!reward", reward),
            self._plot("return", next(iter(returns)), returns),
        ]
        rows = [panels.stack(lights, "row"), panels.stack(plots, "row")]
        if len(lights) < 2:
            rows = [panels.split(rows[0], rows[1], "row", 16.0 if is_wide else 33.3)]
        watched = [name for name in self.telemetry if name.endswith(_WATCHED)]
        if watched:
            title = "offsets, steering" if len(watched) > 1 else watched[0]
            rows.insert(1, self._plot("drive", title, panels.telemetry_series(watched)))
        elif observed := panels.observation_groups(self.metadata):
            parts: dict[str, Node] = {
                title: self._plot(f"drive {title}", title, part) for title, part in observed.items()
            }
            tabs = self._put("Tab!drive", panels.tabs(parts)) if len(parts) > 1 else ""
            rows.append(tabs or next(iter(parts.values())))
        actions, share = self._actions()
        sizes = [(row, (1 - share) / len(rows)) for row in rows]
        return panels.weighted([*sizes, (actions, share)], "column")

    def _gauge(self) -> list[Node]:
        if _SPEED not in self.telemetry:
            return []
        highest = self.metadata.view.get(_SPEED, _HIGHEST_M_S)
        panel = panels.gauge("speed, m/s", f"/telemetry.{_SPEED}", highest)
        return [self._put("Gauge!speed", panel)]

    def _indicator(self) -> list[Node]:
        """Add how the last episode ended; failures are red if the success reasons are known."""
        successes = self.metadata.success_reasons
        colors = {
            INTERRUPTED: panels.NEUTRAL,
            **dict.fromkeys(_REASONS, panels.BAD if successes else panels.NEUTRAL),
            **dict.fromkeys(successes, panels.GOOD),
        }
        # Viewers show the same before the first end and for texts without a color.
        other = (panels.NEUTRAL, "none yet, or another reason")
        path = f"{EPISODE_TOPIC}.reason"
        panel = panels.indicator("how the last episode ended", path, colors, other)
        return [self._put("Indicator!state", panel)]

    def _actions(self) -> tuple[Node, float]:
        """Add a panel of recent logged and policy actions; return its node and relative height."""
        last_s = round(_LAST_STEPS * self.metadata.step_duration_ns / 1e9, 3)
        title = f"the last {last_s:g} s"
        if not self.metadata.action_names():
            return self._commands(last_s)
        rows = {**_RUNNING, "action": f"{panels.STEPS}.action"}
        for topic in self._values_topics():
            name = topic.removeprefix(VALUES_TOPIC).removeprefix("/")
            rows[f"{name} would take".strip()] = f"{topic}.policy_action"
        panel = panels.state_transitions(title, rows, last_s)
        share = panels.share_of_transitions(len(rows))
        return self._put("StateTransitions!actions", panel), share

    def _commands(self, last_s: float) -> tuple[Node, float]:
        """Add a plot of logged and policy commands, the step, and dials of a Box's elements."""
        logged = panels.action_series(self.metadata)
        paths = dict(logged)
        bounded = panels.bounded_actions(self.metadata)[:_MOST_DIALS]
        is_box = isinstance(self.metadata.action_space, spaces.Box)
        for topic in self._values_topics() if is_box else ():
            policy = topic.removeprefix(VALUES_TOPIC).removeprefix("/") or "policy"
            for name, suffix in panels.action_parts(self.metadata).items():
                paths[f"{name}, {policy}"] = f"{topic}.policy_action{suffix or '[0]'}"
        shown = dict(list(paths.items())[: panels.MAX_SERIES])
        # Viewers move a plot of limited width only while data arrive, and not over a file.
        title, options = "actions", dict[str, Any]()
        if self.training:
            title = f"actions of the last {last_s:g} s"
            options = {"isSynced": False, "followingViewWidth": last_s}
        panel = panels.plot(title, shown, **options)
        # A few steps only, so that each has the width of its number.
        steps_s = _SHOWN_STEPS * self.metadata.step_duration_ns / 1e9
        running = panels.state_transitions("episode, step", _RUNNING, round(steps_s, 3))
        pair: list[tuple[Node, float]] = [
            (self._put("Plot!action", panel), 0.6),
            (self._put("StateTransitions!running", running), 0.4),
        ]
        plot = panels.weighted(pair, "row")
        if not bounded:
            return plot, 0.25
        dials: list[Node] = []
        for one in bounded:
            dial = panels.gauge(one.name, logged[one.name], one.high, one.low)
            dials.append(self._put(f"Gauge!action {one.name}", dial))
        rows = [panels.stack(dials[k : k + 2], "row") for k in range(0, len(dials), 2)]
        if len(rows) == 1:
            return panels.weighted([(rows[0], 0.45), (plot, 0.55)], "column"), 0.4
        # Two rows of dials and a plot do not fit into the smallest window.
        tabs = panels.tabs({"over time": plot, "now": panels.stack(rows, "column")})
        return self._put("Tab!actions", tabs), 0.42

    def _returns(self) -> list[tuple[Node, float]]:
        """Add the return of each episode, and an overview of the episodes."""
        path = f"{EPISODE_TOPIC}.total_reward"
        returns = panels.points(panels.plot("return of each episode", {"return": path}), 4)
        rows: dict[str, str] = {"episode": f"{panels.STEPS}.episode"}
        rows["how the episode before ended"] = f"{EPISODE_TOPIC}.reason"
        overview = panels.state_transitions("episodes", rows)
        share = panels.share_of_transitions(len(rows))
        return [
            (self._put("Plot!returns", returns), 0.4),
            (self._put("StateTransitions!episodes", overview), share),
        ]

    def _metrics(self) -> list[tuple[Node, float]]:
        """Add the metrics of training, the most important first."""
        paths = {name: f"{TRAINING_TOPIC}.{name}" for name in self.training}
        rows: list[tuple[Node, float]] = []
        # Scores are between 0 and 1, and returns often far from that.
        first: list[Node] = [
            self._plot(f"training {name}", self.training[name], {name: paths.pop(name)})
            for name in _FIRST_METRICS
            if name in paths
        ]
        if first:
            rows.append((panels.stack(first, "row"), 0.3))
        plots: dict[str, Node] = {
            name.replace("_", " "): self._plot(name, self.training[name], {name: path})
            for name, path in paths.items()
        }
        pair = [plots.pop(name) for name in _NEXT_METRICS if name in plots]
        if pair:
            rows.append((panels.stack(pair, "row"), 0.25))
        if plots:
            rows.append((self._put("Tab!metrics", panels.tabs(plots)), 0.27))
        return rows

    def _policy(self, topic: str) -> Node:
        """Add a policy's outputs over time, current Q-values, errors and agreement with the log."""
        title = topic.removeprefix("/rl/")
        if isinstance(self.metadata.action_space, spaces.Box):
            return self._policy_commands(topic, title)
        names = list(self.metadata.action_names().values())[: panels.MAX_SERIES]
        over_time: dict[str, Node] = {}
        has_q = topic not in self.without_q
        kinds = {**({"Q-values": "q"} if has_q else {}), "probabilities": "preference"}
        for label, array in kinds.items():
            paths = {name: f"{topic}.{array}[{index}]" for index, name in enumerate(names)}
            panel = panels.plot(f"{title}: {label} over time", paths, values=True)
            over_time[label] = self._put(f"Plot!{title} {array}", panel)
        shown = ("Q", "q") if has_q else ("probability", "preference")
        # The plot beside it has the names of the actions.
        now = panels.points_by_index(
            f"{title}: {shown[0]} of each action now", {shown[0]: f"{topic}.{shown[1]}[:]"}
        )
        fields = ("td_error", "advantage", "entropy") if has_q else ("entropy",)
        errors = {name: f"{topic}.{name}" for name in fields}
        label = "TD error, advantage, entropy" if has_q else "entropy"
        pair: list[Node] = [
            self._put(f"Plot!{title} now", now),
            self._plot(f"{title} errors", f"{title}: {label}", errors),
        ]
        share = f"{self.agreement[topic]:.0%} of " if topic in self.agreement else ""
        agreement = panels.state_transitions(
            f"{title}: agrees with {share}the actions of the log", {"agrees": f"{topic}.agrees"}
        )
        rows = [
            (self._put(f"Tab!{title} over time", panels.tabs(over_time)), 0.46),
            (panels.stack(pair, "row"), 0.3),
            (self._put(f"StateTransitions!{title}", agreement), 0.24),
        ]
        return panels.weighted(rows, "column")

    def _policy_commands(self, topic: str, title: str) -> Node:
        """Add a policy's commands beside the logged ones, their difference, and values of both."""
        logged, over_time = panels.action_series(self.metadata), {}
        differences: dict[str, str] = {}
        for name, suffix in panels.action_parts(self.metadata).items():
            place = suffix or "[0]"
            paths = {"log": logged[name], "policy": f"{topic}.policy_action{place}"}
            over_time[name] = self._plot(f"{title} {name}", f"{title}: {name}", paths)
            differences[name] = f"{topic}.difference{place}"
        values = {"Q of the log": f"{topic}.q", "Q of the policy": f"{topic}.value"}
        errors = {name: f"{topic}.{name}" for name in ("td_error", "advantage")}
        pair: list[Node] = [
            self._plot(f"{title} q", f"{title}: Q of both commands", values),
            self._plot(f"{title} errors", f"{title}: TD error, advantage", errors),
        ]
        rows: list[tuple[Node, float]] = [
            (self._put(f"Tab!{title} over time", panels.tabs(over_time)), 0.4),
            (self._plot(f"{title} difference", f"{title}: policy minus log", differences), 0.28),
            (panels.stack(pair, "row"), 0.32),
        ]
        return panels.weighted(rows, "column")

    def _chosen_episode(self) -> Node:
        chosen, title = panels.EPISODE_VARIABLE, "reward of the chosen episode"
        last = self.episodes - 1 if self.episodes else _MAX_EPISODE
        knob = panels.slider("episode to plot", chosen, max(last, 1))
        plot = self._plot("episode", title, {"reward": panels.CHOSEN_REWARD})
        return panels.split(self._put("GlobalVariableSliderPanel!episode", knob), plot, "row", 30)
