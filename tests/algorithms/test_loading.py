"""An agent of an algorithm that knows no cost becomes one that keeps a limit."""

import threading
import warnings

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3 as sb3
import torch as th
from cost_envs import CostPoint

import sb3_guard
from sb3_guard import (
    CPO,
    CPPOPID,
    FOCOPS,
    P3O,
    PCPO,
    SCPO,
    TRPOSL,
    TRPOUSL,
    PPOLag,
    SACLag,
    TD3Lag,
    TQCLag,
    TRPOLag,
    evaluate_policy,
    train,
)
from sb3_guard.algorithms.common.arguments import stated
from sb3_guard.algorithms.common.loading import name_of
from sb3_guard.algorithms.common.rollouts import CostRollouts
from sb3_guard.zoo.run.checkpoint import read_normalizer

SIZE = {"policy_kwargs": {"net_arch": [8]}}
SMALL = {"seed": 0, "gamma": 0.97}
ON = {"n_steps": 40, "policy_kwargs": {"net_arch": [16]}, **SMALL}
OFF = {"learning_starts": 10, "buffer_size": 100, "batch_size": 8, **SMALL}
PAIRS = [
    (sb3.PPO, PPOLag, ON | {"n_epochs": 3, "batch_size": 20}),
    (sb3.A2C, PPOLag, ON),
    (sb3.PPO, FOCOPS, ON | {"batch_size": 20}),
    (sb3.PPO, CPO, ON | {"batch_size": 20}),
    (sb3.PPO, TRPOUSL, ON | {"batch_size": 20}),
    (sb3_contrib.TRPO, CPO, ON),
    (sb3_contrib.TRPO, TRPOLag, ON),
    (sb3_guard.TRPO, CPO, ON),
    (sb3_guard.TRPO, PPOLag, ON),
    (sb3_contrib.TRPO, FOCOPS, ON),
    (sb3.SAC, SACLag, OFF),
    (sb3.TD3, TD3Lag, OFF),
    (sb3_contrib.TQC, TQCLag, OFF),
]


@pytest.mark.parametrize(("theirs", "ours", "arguments"), PAIRS)
def test_what_was_learnt_is_carried_over(theirs, ours, arguments, tmp_path):
    old = theirs("MlpPolicy", CostPoint(10), **arguments)
    old.learn(60)
    old.save(tmp_path / "agent")
    with pytest.warns(UserWarning, match=f"{ours.__name__} goes on .* to begin anew: ") as said:
        new = ours.load(tmp_path / "agent", env=CostPoint(10, hazard=(-1, 0)), cost_limit=3.0)
    (said,) = (str(one.message) for one in said if "goes on" in str(one.message))
    assert said.endswith("cost_limit is 3.0")
    weights = new.policy.state_dict()
    for name, values in old.policy.state_dict().items():
        th.testing.assert_close(weights[name], values)
    obs = np.zeros((5, 4), np.float32)
    np.testing.assert_array_equal(
        new.predict(obs, deterministic=True)[0], old.predict(obs, deterministic=True)[0]
    )
    assert (new.gamma, new.cost_limit) == (0.97, 3.0)
    assert ("clip_range" in said) == (theirs is sb3.PPO and ours in (CPO, TRPOUSL))
    assert ("cost_critic" in said) == (ours is not TRPOUSL)
    new.learn(80)
    assert new.total_cost > 0
    (moved,) = (
        name for name in weights if name.endswith(("action_net.weight", "actor.mu.weight"))
        or name == "actor.mu.4.weight"
    )  # fmt: skip
    assert not th.equal(new.policy.state_dict()[moved], old.policy.state_dict()[moved])
    # From then on it is an agent like others.
    new.save(tmp_path / "safe")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = ours.load(tmp_path / "safe", env=CostPoint(10))
    np.testing.assert_array_equal(again.predict(obs)[0].shape, new.predict(obs)[0].shape)


@pytest.mark.parametrize(("ours", "arguments"), [(CPO, ON), (PPOLag, ON)])
def test_arguments_of_the_policy_are_given_again_as_they_were(ours, arguments, tmp_path):
    given = {"policy_kwargs": {"net_arch": [16]}}
    ours("MlpPolicy", CostPoint(10), cost_limit=3.0, **{**arguments, **given}).save(tmp_path / "a")
    ours.load(tmp_path / "a", **given)
    with pytest.raises(ValueError, match="policy kwargs do not equal"):
        ours.load(tmp_path / "a", policy_kwargs={"net_arch": [8]})


def test_hyperparameters_of_ours_are_not_taken_from_another_algorithm(tmp_path):
    """sb3-contrib's KL is a mean over the dimensions of an action, ours a sum."""
    sb3_contrib.TRPO("MlpPolicy", CostPoint(10), target_kl=0.5, n_steps=40).save(tmp_path / "a")
    with pytest.warns(UserWarning, match="goes on"):
        model = CPO.load(tmp_path / "a", env=CostPoint(10))
    assert model.target_kl == stated(CPO)["target_kl"].default and model.n_steps == 40
    # Our TRPO knows costs, but no limits.
    env = CostPoint(10, cost_keys=("cost", "heat"))
    keys = {"cost_keys": ("cost", "heat"), "target_kl": 0.5}
    sb3_guard.TRPO("MlpPolicy", env, n_steps=40, **keys).save(tmp_path / "b")
    with pytest.warns(UserWarning, match="PPOLag goes on .* cost_limit is 3.0"):
        lagrangian = PPOLag.load(tmp_path / "b", env=env, cost_limit=3.0)
    assert lagrangian.rollout_buffer_kwargs["returns"] == "lambda"
    assert lagrangian.batch_size == 64 and lagrangian.missing_cost == "error"
    assert lagrangian.cost_keys == ("cost", "heat") and lagrangian.target_kl == 0.02
    # Gradient steps are of the critics in a trust region, of the actor in PPO.
    assert (lagrangian.learning_rate, lagrangian.max_grad_norm) == (3e-4, 0.5)
    with pytest.warns(UserWarning, match="CPO goes on"):
        model = CPO.load(tmp_path / "b", env=env)
    assert model.cost_gae_lambda == CPO("MlpPolicy", env).cost_gae_lambda == 0.5
    assert model.learning_rate == 1e-3
    with pytest.raises(TypeError, match="CPO takes no argument 'clip_range'"):
        sb3.PPO("MlpPolicy", CostPoint(10)).save(tmp_path / "ppo")
        CPO.load(tmp_path / "ppo", clip_range=0.3)


def test_gradient_steps_are_the_classs_own_between_a_trust_region_and_others(tmp_path):
    theirs = {"learning_rate": 0.02, "ent_coef": 0.01, "batch_size": 20, "n_steps": 40}
    sb3.PPO("MlpPolicy", CostPoint(10), **theirs).save(tmp_path / "a")
    with pytest.warns(UserWarning, match="an agent of another algorithm; to begin anew: cost_crit"):
        model = PPOLag.load(tmp_path / "a", env=CostPoint(10))
    assert (model.learning_rate, model.ent_coef, model.batch_size) == (0.02, 0.01, 20)
    told = "but for batch_size=None, ent_coef=0.0, learning_rate=0.001, max_grad_norm=0.0, target"
    with pytest.warns(UserWarning, match=told):
        model = CPO.load(tmp_path / "a", env=CostPoint(10))
    assert (model.learning_rate, model.ent_coef, model.batch_size) == (1e-3, 0.0, None)
    TRPOLag("MlpPolicy", CostPoint(10), n_steps=40).save(tmp_path / "b")
    with pytest.warns(UserWarning, match="of TRPOLag, but for batch_size=64, learning_rate=0"):
        model = PPOLag.load(tmp_path / "b", env=CostPoint(10))
    assert (model.batch_size, model.learning_rate) == (64, 3e-4) and model.n_steps == 40
    assert (model.vf_coef, model.max_grad_norm, model.target_kl) == (0.5, 0.5, 0.02)
    PPOLag("MlpPolicy", CostPoint(10), target_kl=None).save(tmp_path / "c")
    with pytest.warns(UserWarning, match="but for .*target_kl"):
        assert TRPOLag.load(tmp_path / "c", env=CostPoint(10)).max_grad_norm == 0
    # What PPO-Lagrangian left behind, no later file has: it is not taken for a trust region.
    model.learning_rate = 1e-4
    model.save(tmp_path / "d")
    with pytest.warns(UserWarning, match="CPPOPID goes on"):
        assert CPPOPID.load(tmp_path / "d", env=CostPoint(10)).learning_rate == 1e-4


def test_what_an_algorithm_fixes_is_no_hyperparameter_of_the_next(tmp_path):
    CPO("MlpPolicy", CostPoint(10), n_steps=40, cost_gamma=0.9).save(tmp_path / "a")
    with pytest.warns(UserWarning, match=r"but for cost_gamma=1\.0"):
        SCPO.load(tmp_path / "a", env=CostPoint(10)).save(tmp_path / "b")
    with pytest.warns(UserWarning, match="but for cost_gamma=None"):
        CPO.load(tmp_path / "b", env=CostPoint(10))
    with pytest.raises(TypeError, match="CPO takes no argument 'vf_coef'"):
        CPO.load(tmp_path / "a", vf_coef=0.3)


class _SafePPO(CostRollouts, sb3.PPO):
    """A user's own that learns what things cost."""

    def _setup_model(self):
        super()._setup_model()
        self.scale = 2.0

    def train(self):
        super().train()
        self.fit_cost_critic()


class _Variant(_SafePPO):
    """Another one, which keeps an account."""

    def __init__(self, *args, **kwargs):
        self.account = []
        super().__init__(*args, **kwargs)

    def train(self):
        super().train()
        self.account.append(self.num_timesteps)


class _Variant2(_Variant):
    """The same with another name."""


def test_a_users_algorithm_is_told_what_it_goes_on_with(tmp_path):
    given = {"policy_kwargs": {"net_arch": [16]}}
    CPO("MlpPolicy", CostPoint(10), n_steps=40, **given).save(tmp_path / "a")
    with pytest.warns(UserWarning, match=r"of CPO, but for batch_size=64, learning_rate=0\.0003"):
        model = _SafePPO.load(tmp_path / "a", env=CostPoint(10), **given)
    model.save(tmp_path / "b")
    with pytest.warns(UserWarning, match="CPO goes on with .* an agent of _SafePPO, but for"):
        CPO.load(tmp_path / "b", env=CostPoint(10), **given)
    assert model.scale == 2.0


def test_a_users_class_goes_on_with_an_agent_of_its_base(tmp_path):
    _Variant("MlpPolicy", CostPoint(10), n_steps=40, batch_size=20).learn(80).save(tmp_path / "a")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = _Variant2.load(tmp_path / "a", env=CostPoint(10))
    assert model.account == [40, 80]


class _Closed(CostRollouts, sb3.PPO):
    """A user's own whose constructor does not hand all arguments on."""

    def __init__(self, policy, env, cost_limit=1.0, device="auto", _init_setup_model=True):
        sizes = {"n_steps": 40, "batch_size": 20, "cost_limit": cost_limit, "device": device}
        super().__init__(policy, env, _init_setup_model=_init_setup_model, **sizes)


def test_a_constructor_may_take_less(tmp_path):
    theirs = sb3.PPO("MlpPolicy", CostPoint(10), n_steps=80, gamma=0.9, batch_size=40, **SIZE)
    theirs.save(tmp_path / "a")
    with pytest.warns(UserWarning, match="_Closed goes on"):
        model = _Closed.load(tmp_path / "a", env=CostPoint(10))
    assert (model.n_steps, model.gamma, model.cost_limit) == (80, 0.9, 1.0)


class _Unpicklable:
    """A schedule with a lock."""

    def __init__(self):
        self.lock = threading.Lock()

    def __call__(self, progress):
        return 1e-3


def test_custom_objects_stay_the_objects_that_they_are(tmp_path):
    sb3.PPO("MlpPolicy", CostPoint(10), n_steps=40).save(tmp_path / "a")
    schedule = _Unpicklable()
    with pytest.warns(UserWarning, match="goes on"):
        model = PPOLag.load(tmp_path / "a", custom_objects={"learning_rate": schedule})
    assert model.learning_rate is schedule


class _SafeA2C(CostRollouts, sb3.A2C):
    """Another one, which makes one pass over the whole rollout."""


def test_a_users_hyperparameters_are_not_those_of_the_next(tmp_path):
    sizes = {"n_steps": 40, **SIZE}
    _SafePPO("MlpPolicy", CostPoint(10), n_epochs=10, batch_size=20, **sizes).save(tmp_path / "a")
    with pytest.warns(UserWarning, match="left behind: .*batch_size"):
        model = _SafeA2C.load(tmp_path / "a", env=CostPoint(10))
    assert not {"batch_size", "n_epochs"} & {*vars(model)}
    _Costly("MlpPolicy", CostPoint(10), **sizes).save(tmp_path / "a")
    with pytest.warns(UserWarning, match="left behind: .*cg_max_steps"):
        P3O.load(tmp_path / "a", env=CostPoint(10), learning_rate=1e-4).save(tmp_path / "b")
    with pytest.warns(UserWarning, match="but for batch_size=None, .*learning_rate=0.001"):
        CPO.load(tmp_path / "b", env=CostPoint(10))


class _Counting(sb3.PPO):
    """Attributes of one's own that ours use for something else."""

    def __init__(self, *args, **kwargs):
        self.total_cost, self.episodes, self.ep_cost_buffer = 0.0, 7, [1.0]
        self.cost_limit = np.array([1.0, 2.0])
        super().__init__(*args, **kwargs)


@pytest.mark.parametrize("theirs", [sb3.PPO, _Counting])
def test_what_was_learnt_is_continued_without_a_reset(theirs, tmp_path):
    env = sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(10)])
    theirs("MlpPolicy", env, n_steps=40, batch_size=20).learn(40).save(tmp_path / "a")
    with pytest.warns(UserWarning, match="goes on"):
        model = PPOLag.load(tmp_path / "a", env=env, cost_limit=1.0, force_reset=False)
    model.learn(40, reset_num_timesteps=False)
    assert (model.num_timesteps, model.cost_limit) == (80, 1.0) and len(model.ep_cost_buffer) == 4


def test_another_number_of_costs_is_counted_anew(tmp_path):
    env = CostPoint(10, cost_keys=("cost", "heat"))
    sb3_guard.TRPO("MlpPolicy", env, n_steps=40).learn(40).save(tmp_path / "a")
    keys = {"cost_keys": ("cost", "heat"), "cost_limit": [1.0, 2.0]}
    with pytest.warns(UserWarning, match="goes on"):
        model = CPO.load(tmp_path / "a", env=env, **keys)
    assert model.learn(40, reset_num_timesteps=False).total_costs.shape == (2,)


@pytest.mark.parametrize(("theirs", "ours"), [(sb3.SAC, SACLag), (sb3_contrib.TQC, TQCLag)])
def test_a_buffer_that_saves_memory_is_not_carried_over(theirs, ours, tmp_path):
    """SB3 takes ``optimize_memory_usage`` with these arguments only."""
    saving = {"optimize_memory_usage": True, "buffer_size": 100}
    saving["replay_buffer_kwargs"] = {"handle_timeout_termination": False}
    theirs("MlpPolicy", CostPoint(10), **saving).save(tmp_path / "a")
    with pytest.warns(UserWarning, match=f"{ours.__name__} goes on"):
        assert not ours.load(tmp_path / "a", env=CostPoint(10)).optimize_memory_usage


def test_a_limit_on_something_else_begins_with_a_critic_of_its_own(tmp_path):
    """CPO's cost units, margin and cost critic are of the sum of an episode, SCPO's of its worst
    step."""
    env = CostPoint(50, hazard=(-1, 0))
    CPO("MlpPolicy", env, cost_limit=1.0, n_steps=400, seed=0).learn(2000).save(tmp_path / "a")
    with pytest.warns(UserWarning, match=r"anew: cost_critic, cost_critic\.optimizer;"):
        model = SCPO.load(tmp_path / "a", env=env, cost_limit=0.5)
    assert model.cost_units is None and model.margin is None
    with pytest.warns(UserWarning, match=r"but for cost_gamma=1\.0, cost_limit=0\.0"):
        SCPO.load(tmp_path / "a", env=env)
    with pytest.warns(UserWarning, match="anew: nothing"):
        assert PCPO.load(tmp_path / "a", env=env).cost_units > 0


class _MyTRPO(sb3_guard.TRPO):
    """A user's own."""


class _Costly(CostRollouts, sb3_contrib.TRPO):
    """A user's own with a cost critic."""


@pytest.mark.parametrize("ours", [CPO, FOCOPS, PPOLag, TRPOSL])
def test_a_users_trpo_is_one(ours, tmp_path):
    _MyTRPO("MlpPolicy", CostPoint(10), **ON).save(tmp_path / "a")
    with pytest.warns(UserWarning, match=f"{ours.__name__} goes on .* cost_limit is 3.0"):
        ours.load(tmp_path / "a", env=CostPoint(10), cost_limit=3.0).learn(40)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _MyTRPO.load(tmp_path / "a")
        sb3_guard.TRPO.load(tmp_path / "a")


def test_only_ours_has_the_name_of_ours():
    assert name_of(_MyTRPO) == "TRPO" and name_of(_Costly) == "_Costly"
    assert name_of(type("CPO", (_SafePPO,), {"__module__": "mine"})) == "mine.CPO"


class _MyPolicy(sb3.common.policies.ActorCriticPolicy):
    """A user's own."""


def test_another_kind_of_policy_is_refused(tmp_path):
    for cls, kind in (sb3.SAC, "SACPolicy"), (SACLag, "SACPolicy"):
        cls("MlpPolicy", CostPoint(10)).save(tmp_path / "sac")
        for ours in PPOLag, TQCLag, TD3Lag:
            with pytest.raises(ValueError, match=f"{ours.__name__} can't take over .* a {kind}"):
                ours.load(tmp_path / "sac", env=CostPoint(10))
    sb3_contrib.RecurrentPPO("MlpLstmPolicy", CostPoint(10)).save(tmp_path / "recurrent")
    with pytest.raises(ValueError, match=r"CPO can't take over .* a RecurrentActorCriticPolicy"):
        CPO.load(tmp_path / "recurrent", env=CostPoint(10))
    sb3.PPO(_MyPolicy, CostPoint(10), n_steps=40, batch_size=20).save(tmp_path / "ppo")
    with pytest.warns(UserWarning, match="CPO goes on"):
        assert isinstance(CPO.load(tmp_path / "ppo").policy, _MyPolicy)


def test_a_missing_network_of_sb3s_is_still_an_error(tmp_path):
    model = PPOLag("MlpPolicy", CostPoint(10), n_steps=40, batch_size=20, cost_limit=1.0)
    with pytest.raises(ValueError, match="policy"):
        model.set_parameters({"policy.optimizer": model.policy.optimizer.state_dict()})
    given = model.get_parameters()
    with pytest.raises(ValueError, match="cost_critic"):
        model.set_parameters({name: given[name] for name in given if name != "cost_critic"})
    filtered = TRPOSL("MlpPolicy", CostPoint(10), n_steps=40, batch_size=20, cost_limit=1.0)
    given = filtered.get_parameters()
    optimizer = "policy.action_filter.optimizer"
    with pytest.raises(ValueError, match=optimizer):
        filtered.set_parameters({name: given[name] for name in given if name != optimizer})


def test_arguments_of_load_are_checked(tmp_path):
    CPO("MlpPolicy", CostPoint(10), n_steps=40, cost_limit=1.0).save(tmp_path / "a")
    model = CPO.load(tmp_path / "a", cost_limit=2.0, num_timesteps=7)
    assert (model.cost_limit, model.num_timesteps) == (2.0, 7)
    with pytest.raises(TypeError, match="CPO takes no argument 'cost_limt'; did you mean 'cost_l"):
        CPO.load(tmp_path / "a", cost_limt=2.0)
    with pytest.raises(TypeError, match="PPOLag takes no argument 'cg_max_steps'"):
        PPOLag.load(tmp_path / "a", cg_max_steps=3)


def test_other_networks_are_told_in_a_line(tmp_path):
    TRPOSL("MlpPolicy", CostPoint(10), cost_limit=1.0, n_steps=40).save(tmp_path / "a")
    with pytest.raises(ValueError, match=r"TRPOUSL: the file has other networks: [^\n]*noise"):
        TRPOUSL.load(tmp_path / "a")


def test_an_agent_of_normalised_observations_says_so(tmp_path):
    """Where the environment has no statistics: it would act on something else, and be judged."""
    venv = sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(10)])
    env = sb3.common.vec_env.VecNormalize(venv)
    CPO("MlpPolicy", env, n_steps=40, cost_limit=1.0).learn(40).save(tmp_path / "a")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        normalized = CPO.load(tmp_path / "a", env=env)
        evaluate_policy(normalized, env, 5)
    with pytest.warns(UserWarning, match="learnt from normalised .* no VecNormalize"):
        evaluate_policy(normalized, sb3.common.vec_env.VecNormalize(venv, norm_obs=False), 5)
    with pytest.warns(UserWarning, match="learnt from normalised observations: wrap its env"):
        CPO.load(tmp_path / "a", env=sb3.common.vec_env.VecNormalize(venv))  # of no observation
    for given in (None, venv):
        with pytest.warns(UserWarning, match="learnt from normalised observations: wrap its env"):
            model = CPO.load(tmp_path / "a", env=given)
        for other in (venv, sb3.common.vec_env.VecNormalize(venv, norm_obs=False)):
            with pytest.warns(UserWarning, match="learnt from normalised .* no VecNormalize"):
                evaluate_policy(model, other, 5)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            evaluate_policy(model, env, 5)


class _MyPPOLag(PPOLag):
    """A user's own."""


def test_an_agent_of_another_class_of_ours_is_told(tmp_path):
    """And refused where its networks are others; a user's class may go on with its base's."""
    sizes = {"n_steps": 40, "batch_size": 20}
    PPOLag("MlpPolicy", CostPoint(10), cost_limit=1.0, **sizes).save(tmp_path / "a")
    with pytest.raises(ValueError, match=r"CPO: .* do not match, none is absent, multiplier, mult"):
        CPO.load(tmp_path / "a", env=CostPoint(10))
    with pytest.warns(UserWarning, match="CPPOPID goes on with .* agent of PPOLag; to begin"):
        CPPOPID.load(tmp_path / "a").save(tmp_path / "b")
    with pytest.warns(UserWarning, match="PPOLag goes on with .* an agent of CPPOPID"):
        PPOLag.load(tmp_path / "b")  # of that one since then
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _MyPPOLag.load(tmp_path / "a").save(tmp_path / "c")
        PPOLag.load(tmp_path / "c")


@pytest.mark.parametrize("beside", ["ppo_vecnormalize.pkl", "run/vecnormalize.pkl", None])
def test_train_goes_on_with_the_statistics_beside_the_agent(tmp_path, capsys, beside):
    env = sb3.common.vec_env.DummyVecEnv([lambda: CostPoint(20)])
    statistics = sb3.common.vec_env.VecNormalize(env)
    statistics.obs_rms.count = 5000.0
    (tmp_path / "run").mkdir()
    if beside:
        statistics.save(str(tmp_path / beside))
    agent = sb3.PPO("MlpPolicy", statistics, n_steps=30, batch_size=30, seed=0)
    agent.save(tmp_path / "ppo")
    run = "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20".split()
    run += "-params n_envs:2 n_steps:30 batch_size:60 cost_limit:4.0 normalize:True".split()
    run += ["--algo", "ppo_lag", "-n", "60", "--eval-freq", "-1", "--device", "cpu"]
    run += ["-f", str(tmp_path / "logs"), "-i", str(tmp_path / "ppo.zip")]
    with pytest.warns(UserWarning, match="PPOLag goes on"):
        assert train.main(run) == 0
    said = "ppo.zip: observation statistics begin anew"
    assert capsys.readouterr().out.count(said) == (beside is None)
    (file,) = (tmp_path / "logs" / "ppo_lag").rglob("vecnormalize.pkl")
    assert (read_normalizer(file).obs_rms.count > 5000) == (beside is not None)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "the agent learnt from normalised observations")
        assert train.main(["-i", str(file.parents[1]), "-n", "120", *run[:2]]) == 0


def test_train_goes_on_from_an_agent_of_sb3s(tmp_path):
    agent = sb3.PPO("MlpPolicy", CostPoint(20), n_steps=30, batch_size=30, seed=0)
    agent.save(tmp_path / "ppo")
    run = "--gym-packages registered_envs --env CostPoint-v0 --env-kwargs episode_length:20".split()
    run += "-params n_envs:2 n_steps:30 batch_size:60 cost_limit:4.0 normalize:False".split()
    run += ["--algo", "ppo_lag", "-n", "60", "--eval-freq", "-1", "--verbose", "0"]
    run += ["--device", "cpu", "-f", str(tmp_path / "logs"), "-i", str(tmp_path / "ppo.zip")]
    with pytest.warns(UserWarning, match="PPOLag goes on"):
        assert train.main([*run, "--save-freq", "60"]) == 0
    (folder,) = (tmp_path / "logs" / "ppo_lag").iterdir()
    assert (folder / "result.json").exists()
