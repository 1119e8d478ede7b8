"""Normalised frames and images with a replay buffer, which keeps what VecNormalize is given."""

import numpy as np
import pytest
from cost_envs import RandomCostEnv
from gymnasium import register, registry, spaces
from stable_baselines3.common.vec_env import (
    unwrap_vec_normalize,
)
from typed import LENGTH, TOY

from sb3_guard import enjoy, export_agent, make_model, train

ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)
VECTOR = spaces.Box(-1.0, 1.0, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
SPACES = {"Vector": VECTOR, "Image": IMAGE, "Both": spaces.Dict(camera=IMAGE, speed=VECTOR)}
TINY = {"learning_starts": 4, "batch_size": 4, "buffer_size": 50, "seed": 0, "device": "cpu"}


@pytest.fixture
def envs():
    for name, space in SPACES.items():
        register(f"{name}-v0", entry_point=lambda space=space: RandomCostEnv(space, ACTIONS))
    yield
    for name in SPACES:
        del registry[f"{name}-v0"]


@pytest.mark.parametrize(("algo", "frames"), [("sac_lag", 2), ("sac", None)])
@pytest.mark.parametrize(
    ("env", "policy", "normalize"),
    [
        ("Vector", "MlpPolicy", True),
        ("Image", "MlpPolicy", True),
        ("Image", "CnnPolicy", {"norm_obs": False}),
        ("Both", "MultiInputPolicy", {"norm_obs_keys": ["speed"]}),
    ],
)
def test_frames_and_images_are_shaped_before_they_are_normalised(
    algo, frames, env, policy, normalize, envs
):
    limit = {"cost_limit": 1.0} if algo == "sac_lag" else {}
    model = make_model(
        algo, f"{env}-v0", n_envs=1, policy=policy, normalize=normalize, frame_stack=frames,
        policy_kwargs={"net_arch": [4]}, **limit, **TINY,
    ).learn(10)  # fmt: skip
    normalizer = unwrap_vec_normalize(model.get_env())
    batch = model.replay_buffer.sample(20)
    observed = batch.observations if env == "Both" else {"": batch.observations}
    within = normalizer.observation_space
    within = within.spaces if env == "Both" else {"": within}
    for name, space in within.items():
        assert observed[name].shape[1:] == space.shape
    if env == "Vector":
        np.testing.assert_array_equal(normalizer.obs_rms.mean.shape, (3 * (frames or 1),))


def test_a_run_with_normalised_frames_is_resumed_played_and_exported(tmp_path, capsys):
    which = [*TOY, "--algo", "sac_lag", "-f", str(tmp_path)]
    how = "frame_stack:3 normalize:True n_envs:2 learning_starts:10 cost_limit:2".split()
    how = ["-params", *how, *LENGTH, "--eval-freq", "40", "--eval-episodes", "2"]
    assert train.main([*which, *how, "-n", "80"]) == 0
    (run,) = (tmp_path / "sac_lag").glob("CostPoint-v0_*")
    assert train.main([*TOY[:2], "-i", str(run), "-n", "120"]) == 0
    assert enjoy.main([*which, "--n-episodes", "2", "--no-render", "--load-best"]) == 0
    there = ["--n-episodes", "2", "-o", str(tmp_path / "policy.onnx")]
    assert export_agent.main([*which, *there]) == 0
