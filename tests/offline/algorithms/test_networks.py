"""Tests of networks: inputs, outputs, and K networks evaluated in parallel."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from mcaprl.architecture import ENCODERS, Architecture
from mcaprl.errors import UsageError
from mcaprl.networks import ImageInput, Network
from mcaprl.offline.algorithms.config import BCConfig
from mcaprl.offline.algorithms.models import AnyModel, Model, StackedMLP, build_model
from mcaprl.offline.batches.observations import Observations


def vectors(rows: int, width: int, seed: int = 0) -> Observations:
    return Observations(torch.randn(rows, width, generator=torch.Generator().manual_seed(seed)))


def images(rows: int, *shapes: tuple[int, ...], width: int = 0) -> Observations:
    images = [torch.randint(0, 256, (rows, *shape), dtype=torch.uint8) for shape in shapes]
    return Observations(torch.randn(rows, width), tuple(images))


def weights_of(network: torch.nn.Module) -> list[tuple[int, ...]]:
    return [tuple(p.shape) for p in network.parameters() if p.ndim > 1]


def test_vectors_go_through_the_hidden_layers() -> None:
    network = Network(12, [], (9,), Architecture((256, 128)))
    assert weights_of(network) == [(256, 12), (128, 256), (9, 128)]
    assert network(vectors(5, 12)).shape == (5, 9)


def test_without_hidden_layers_the_network_is_linear() -> None:
    network = Network(3, [], (2,), Architecture(()))
    left, right = torch.randn(2, 4, 3)
    outputs = [network(Observations(x)) for x in (left, right, left + right, torch.zeros(4, 3))]
    torch.testing.assert_close(outputs[0] + outputs[1], outputs[2] + outputs[3])


def test_the_nature_network_has_its_published_size() -> None:
    network = Network(0, [ImageInput((84, 84, 4))], (18,), Architecture((512,)))
    convolutions = [(32, 4, 8, 8), (64, 32, 4, 4), (64, 64, 3, 3)]
    assert weights_of(network) == [*convolutions, (512, 3136), (18, 512)]


def test_the_number_of_channels_is_configurable() -> None:
    architecture = Architecture((256,), channels=(16, 32, 24))
    network = Network(0, [ImageInput((84, 84, 1))], (6,), architecture)
    convolutions = [(16, 1, 8, 8), (32, 16, 4, 4), (24, 32, 3, 3)]
    assert weights_of(network) == [*convolutions, (256, 24 * 49), (6, 256)]


@pytest.mark.parametrize("shape", [(84, 84, 1), (36, 48, 3)])
def test_images_go_through_convolutions(shape: tuple[int, ...]) -> None:
    network = Network(0, [ImageInput(shape)], (4,), Architecture((16,)))
    assert network(images(2, shape)).shape == (2, 4)


def test_small_images_have_two_convolutions_of_three_pixels() -> None:
    # 10 -> 8 -> 3 pixels: (10 - 3) / 1 + 1 and (8 - 3) // 2 + 1.
    network = Network(0, [ImageInput((10, 10, 4))], (6,), Architecture((128,), encoder="nature"))
    assert weights_of(network) == [(16, 4, 3, 3), (32, 16, 3, 3), (128, 3 * 3 * 32), (6, 128)]
    assert network(images(5, (10, 10, 4))).shape == (5, 6)


@pytest.mark.parametrize("name", ["nature", "compact", "small", "auto"])
@pytest.mark.parametrize("shape", [(8, 8, 3), (10, 10, 7), (35, 35, 1), (35, 84, 3)])
def test_grids_of_cells_have_the_small_encoder_whatever_is_named(
    name: str, shape: tuple[int, ...]
) -> None:
    architecture = BCConfig(encoder=name).architecture_for([shape[2]])
    assert architecture.encoder_of(shape) == ENCODERS["small"]


def test_encoders_that_can_be_named() -> None:
    cameras = [(BCConfig(encoder=each), each) for each in ("nature", "compact", "small")]
    for config, name in cameras:
        assert config.architecture_for([3]).encoder_of((84, 84, 3)) == ENCODERS[name]
    # 84 -> 82 -> 40 pixels.
    assert Architecture((16,), encoder="small").features((84, 84, 3)) == 40 * 40 * 32
    assert BCConfig(encoder="small", channels=(4, 5)).architecture_for([1]).channels == (4, 5)
    with pytest.raises(UsageError, match="channels must be 2 numbers of at least 1"):
        BCConfig(encoder="small", channels=(4, 5, 6))
    # Two widths without a name still select the compact encoder.
    assert BCConfig(channels=(4, 5)).architecture_for([3]).encoder == "compact"


def test_a_small_image_and_a_camera_have_their_own_convolutions() -> None:
    architecture = Architecture((16,), channels=(4, 5, 6), encoder="nature")
    network = Network(0, [ImageInput((36, 36, 1)), ImageInput((8, 9, 2))], (2,), architecture)
    kernels = [shape for shape in weights_of(network) if len(shape) == 4]
    assert kernels == [(4, 1, 8, 8), (5, 4, 4, 4), (6, 5, 3, 3), (4, 2, 3, 3), (5, 4, 3, 3)]
    assert network(images(3, (36, 36, 1), (8, 9, 2))).shape == (3, 2)


def test_images_and_vector_are_joined_after_one_layer_each() -> None:
    network = Network(
        3, [ImageInput((36, 36, 1)), ImageInput((40, 36, 2))], (4,), Architecture((8, 6))
    )
    assert weights_of(network.body) == [(6, 24)]
    both = images(2, (36, 36, 1), (40, 36, 2), width=3)
    assert network(both).shape == (2, 4)
    for part in (*both.images, both.vector):
        before = network(both)
        part.add_(1)
        assert not torch.equal(network(both), before)


def test_channels_are_not_mixed_with_rows() -> None:
    # With equal channels, the order of the weights does not matter.
    network = Network(0, [ImageInput((36, 36, 2))], (3,), Architecture((16,)))
    image = torch.randint(0, 256, (1, 36, 36, 1), dtype=torch.uint8)
    twice = Observations(torch.empty(1, 0), (torch.cat([image, image], dim=3),))
    first = next(network.parameters())
    with torch.no_grad():
        before = network(twice)
        first.copy_(first.flip(1))
        torch.testing.assert_close(network(twice), before)


@pytest.mark.parametrize("output_shape", [(4,), (4, 5)])
def test_dueling_advantages_have_mean_zero(output_shape: tuple[int, ...]) -> None:
    network = Network(3, [], output_shape, Architecture((16, 8), dueling=True))
    seen = vectors(6, 3)
    head: Any = network.head
    value = head.value(network.body(network.stems[0](seen.vector)))
    torch.testing.assert_close(network(seen).mean(1).flatten(), value.flatten())


def test_layer_norm_keeps_outputs_invariant_to_the_first_layers_scale() -> None:
    network = Network(3, [], (2,), Architecture((32, 16), layer_norm=True))
    seen = vectors(4, 3)
    before = network(seen)
    with torch.no_grad():
        for parameter in list(network.stems[0].parameters())[:2]:
            parameter.mul_(10)
    torch.testing.assert_close(network(seen), before, rtol=1e-3, atol=1e-3)


def networks(
    count: int, hidden: tuple[int, ...] = (32, 16), *, outputs: int = 4, layer_norm: bool = False
) -> list[Network]:
    torch.manual_seed(3)
    found = [Network(5, [], (outputs,), Architecture(hidden, (), layer_norm)) for _ in range(count)]
    for parameter in (each for network in found for each in network.parameters()):
        parameter.data += 0.1 * torch.randn(parameter.shape)
    return found


def gradients(model: Model, observations: Observations, d_output: Tensor) -> tuple[Tensor, Tensor]:
    outputs = model(observations)
    torch.autograd.backward(outputs, d_output)
    assert model.weights.grad is not None
    return outputs.detach(), model.weights.grad


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("outputs", [1, 4])
@pytest.mark.parametrize("hidden", [(), (32,), (32, 16, 24)])
@pytest.mark.parametrize("seeds", [1, 3])
def test_stacked_networks_have_the_gradients_of_separate_ones(
    seeds: int, hidden: tuple[int, ...], outputs: int, layer_norm: bool
) -> None:
    seen, d_output = vectors(seeds * 7, 5), torch.randn(seeds * 7, outputs)
    both = []
    for kind in (StackedMLP, AnyModel):
        mine = Observations(seen.vector.clone().requires_grad_())
        model = kind(networks(seeds, hidden, outputs=outputs, layer_norm=layer_norm))
        both.append([*gradients(model, mine, d_output), mine.vector.grad])
    for stacked, separate in zip(*both, strict=True):
        torch.testing.assert_close(stacked, separate, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", [StackedMLP, AnyModel])
def test_the_networks_of_an_ensemble_see_the_same_rows(kind: type[Model]) -> None:
    each, seen = networks(4, outputs=1), vectors(2 * 7, 5)
    # Networks 0 and 1 belong to the first seed, which has the first seven rows.
    parts = seen.split(7)
    expected = torch.stack(
        [
            torch.cat([each[0](parts[0]), each[2](parts[1])]).flatten(),
            torch.cat([each[1](parts[0]), each[3](parts[1])]).flatten(),
        ]
    )
    model = kind(networks(4, outputs=1), 2)
    assert model.weights.shape[0] == 2
    torch.testing.assert_close(model(seen), expected)
    torch.testing.assert_close(model(seen, members=1), expected[:1])


@pytest.mark.parametrize("kind", [StackedMLP, AnyModel])
def test_frozen_weights_have_no_gradient(kind: type[Model]) -> None:
    model = kind(networks(4, outputs=1), 2)
    seen = Observations(vectors(2 * 7, 5).vector.requires_grad_())
    torch.autograd.backward(model(seen, frozen=True, members=1).sum())
    assert model.weights.grad is None
    assert seen.vector.grad is not None
    assert seen.vector.grad.abs().min() > 0


@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(1, 70),
    outputs=st.integers(1, 9),
    hidden=st.lists(st.integers(2, 40), max_size=2),
    layer_norm=st.booleans(),
    members=st.sampled_from([1, 2]),
)
@example(rows=256, outputs=1, hidden=[128, 128], layer_norm=False, members=2)
@example(rows=256, outputs=2, hidden=[128, 128], layer_norm=True, members=1)
def test_a_seed_gets_the_same_bits_alone_and_with_others(
    rows: int, outputs: int, hidden: list[int], layer_norm: bool, members: int
) -> None:
    outputs = 1 if members > 1 else outputs
    each = networks(3 * members, tuple(hidden), outputs=outputs, layer_norm=layer_norm)
    seen = vectors(3 * rows, 5).vector

    def found(first: int, last: int) -> list[Tensor]:
        own = [copy.deepcopy(network) for network in each[first * members : last * members]]
        model = build_model(own, members)
        # As in a loss, the gradient of the outputs depends on them, and on their layout in memory.
        inputs = seen[first * rows : last * rows].clone().requires_grad_()
        values = model(Observations(inputs))
        torch.autograd.backward(values.tanh().square().sum())
        assert model.weights.grad is not None
        assert inputs.grad is not None
        values = values.T if members > 1 else values
        return [values.detach(), inputs.grad, model.weights.grad]

    together = found(0, 3)
    for k in range(3):
        for alone, beside in zip(found(k, k + 1), together, strict=True):
            assert torch.equal(alone, beside[k * len(alone) : (k + 1) * len(alone)])


def test_a_network_has_the_weights_of_its_model() -> None:
    model = build_model(networks(2))
    seen = vectors(6, 5)
    with torch.no_grad():
        model.weights.mul_(0.5)
    expected = torch.cat(
        [net(part) for net, part in zip(model.networks, seen.split(3), strict=True)]
    )
    torch.testing.assert_close(model(seen), expected)


def test_a_copy_has_separate_weights() -> None:
    model = build_model(networks(2))
    clone = model.clone()
    before = clone(vectors(4, 5))
    with torch.no_grad():
        model.weights.zero_()
    assert torch.equal(clone(vectors(4, 5)), before)
    assert before.abs().min() > 0


@pytest.mark.parametrize(
    ("network", "kind"),
    [
        (Network(5, [], (4,), Architecture((8,))), StackedMLP),
        (Network(5, [], (4, 3), Architecture((8,))), StackedMLP),
        (Network(5, [], (4,), Architecture((8,), layer_norm=True)), StackedMLP),
        (Network(5, [], (4,), Architecture((8,), dueling=True)), AnyModel),
        (Network(5, [], (1,), Architecture((8,))), StackedMLP),
        (Network(1, [], (4,), Architecture((8,))), AnyModel),
        (Network(0, [ImageInput((36, 36, 1))], (4,), Architecture((8,))), AnyModel),
    ],
)
def test_plain_networks_are_stacked(network: Network, kind: type[Model]) -> None:
    assert type(build_model([network])) is kind
