"""Sims without wrappers, episodes of their pilots, their images, and checks of their shapes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.sims import make_sim
from mcaprl.sims.drawing.scene import Color, Frame, Shape
from mcaprl.sims.evaluation.evaluate import make_pilot

Image = NDArray[np.uint8]

DRAWN_BY_POINTS = {"line": 1, "segments": 2, "triangles": 3, "points": 1, "spheres": 1, "arrow": 2}


def unwrapped(name: str, /, **kwargs: Any) -> Any:
    """Return a sim without wrappers."""
    return make_sim(name, **kwargs).unwrapped


def action_of(space: spaces.Space[Any], number: int) -> Any:
    """Return an action of a space that depends on a number only."""
    if isinstance(space, spaces.Discrete):
        return number % int(space.n)
    drawn = np.random.default_rng(number).uniform(-1.0, 1.0, space.shape)
    # Some parts are at their limits.
    return np.clip(1.2 * drawn, -1.0, 1.0).astype(np.float32)


def batched(observation: Any, count: int = 1) -> Any:
    """Repeat an observation along a new leading dimension."""
    if isinstance(observation, dict):
        return {key: batched(value, count) for key, value in observation.items()}
    return np.stack([observation] * count)


def piloted(name: str, /, seed: int, **kwargs: Any) -> tuple[float, str, list[dict[str, Any]]]:
    """Let the pilot drive an episode; return its total reward, its reason and the infos."""
    env = make_sim(name, **kwargs)
    pilot = make_pilot(env)
    observation, _ = env.reset(seed=seed)
    total, done, infos = 0.0, False, []
    while not done:
        actions = pilot.act(batched(observation))
        observation, reward, terminated, truncated, info = env.step(actions[0])
        total, done = total + float(reward), terminated or truncated
        infos.append(info)
    return total, infos[-1].get("reason", "time_limit"), infos


def image_of(name: str, pose: Any, actions: Sequence[int] = (), **kwargs: Any) -> Image:
    """Return the image of a sim after actions from a pose."""
    env = make_sim(name, render_mode="rgb_array", **kwargs)
    env.reset(seed=0, options={"pose": pose})
    for action in actions:
        env.step(action)
    image: Any = env.render()
    env.close()
    assert (image.dtype, image.shape[2]) == (np.uint8, 3)
    return np.asarray(image)


def near(image: Image, color: Color, tolerance: int = 2) -> NDArray[np.bool_]:
    """Return which pixels have a color, up to rounding."""
    wanted = np.round(255 * np.array(color[:3]))
    return np.asarray(np.all(np.abs(image - wanted) <= tolerance, axis=-1))


def rotated(frame: Frame, vector: tuple[float, float, float]) -> NDArray[np.float64]:
    """Rotate a vector from a frame into its parent: v + 2 u x (u x v + w v)."""
    axis, w = np.array(frame.rotation[:3]), frame.rotation[3]
    cross = np.cross(axis, vector) + w * np.array(vector)
    turned: NDArray[np.float64] = np.array(vector) + 2 * np.cross(axis, cross)
    return turned


def check_shape(shape: Shape, frames: Collection[str]) -> None:
    """Check that a viewer can draw a shape."""
    assert all(0.0 <= part <= 1.0 for part in shape.color)
    assert shape.points.dtype == np.float64
    assert shape.points.shape == (len(shape.points), 3)
    assert np.isfinite(shape.points).all()
    assert shape.frame in frames
    if shape.kind in DRAWN_BY_POINTS:
        assert len(shape.points) > 0
        assert len(shape.points) % DRAWN_BY_POINTS[shape.kind] == 0
    else:
        assert len(shape.points) == 0
        assert min(shape.size) > 0.0
