"""Files of policies of earlier versions have the same actions, values and probabilities as then."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mcaprl.api.policies import load_policy
from tests.golden.make_policies import CASES, FOLDER, outputs, restored


@pytest.mark.parametrize("name", CASES)
def test_a_policy_does_what_it_did(name: str) -> None:
    policy = load_policy(FOLDER / name)
    with np.load(FOLDER / f"{Path(name).stem}.npz") as known:
        found = outputs(policy, restored(known))
        assert found.keys() == {each for each in known if not each.startswith("observation")}
        for output, values in found.items():
            assert values.dtype == known[output].dtype, output
            np.testing.assert_allclose(values, known[output], rtol=1e-5, atol=1e-6, err_msg=output)
        assert len(np.unique(known["actions"])) > 1
    assert policy.env_kwargs == ({} if name.startswith("sb3") else {"height": 2})
    assert (policy.observation_space is None) == name.startswith("sb3")
