"""Export a trained agent: ``sb3-guard export --algo cpo --env Goal_Point_8Hazards``.

The file comes with what the agent was trained at and measured. ``sb3_guard.export`` is the function
that exports a model, so the command's module has another name.
"""

import hashlib
import json
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from sb3_guard.common.evaluation import evaluate_policy
from sb3_guard.deployment import onnx_file
from sb3_guard.judging import Mean
from sb3_guard.zoo.agents.flags import ExportFlags as Flags
from sb3_guard.zoo.agents.playback import BATCH, EPISODES, open_agent
from sb3_guard.zoo.cli.flags import command
from sb3_guard.zoo.cli.usage import UsageError, explained
from sb3_guard.zoo.run.make_envs import BAD_NUMBERS


def export_agent(flags: Flags) -> int:
    """Write the file and its contract, and say what they are."""
    path = Path(flags.output)
    if path.suffix != ".onnx":
        raise UsageError(f"--output {flags.output!r} must end in .onnx")
    agent = open_agent(flags, None, min(flags.n_episodes or BATCH, BATCH))
    with closing(agent.env):
        how: dict[str, Any] = {"deterministic": not agent.stochastic, "seed": flags.seed}
        episodes = flags.n_episodes or EPISODES
        print(f"Playing {episodes} episodes: --n-episodes 1 plays one", flush=True)
        with explained(f"can't play {agent.path}", *BAD_NUMBERS):
            evaluation = evaluate_policy(agent.model, agent.env, episodes, **how)
        settings, certificate = agent.run.hyperparams(), agent.certificate
        limits = evaluation.limits
        costs = {
            key: {**Mean.of(cost).data(), "limit": limit if np.isfinite(limit) else None}
            for key, cost, limit in zip(
                limits.keys, evaluation.limited.T, limits.values.tolist(), strict=True
            )
        }
        measured = {
            "episodes": len(evaluation),
            "return": Mean.of(evaluation.returns).data(),
            "costs": costs,
        }
        trained = {
            "algo": flags.algo,
            "env": agent.env_id,
            "env_kwargs": settings.get("env_kwargs") or {},
            "cost_limit": settings.get("cost_limit"),
            "model_sha256": hashlib.sha256(agent.path.read_bytes()).hexdigest(),
            "measured": measured,
            "certificate": json.loads(certificate.to_json()) if certificate else None,
        }
        with explained(f"can't export {agent.path}", ValueError, ImportError):
            contract = onnx_file.export(
                agent.model,
                path,
                env=agent.env,
                sampled=agent.stochastic,
                stop=flags.stop,
                trained=trained,
            )
    steps = f"{agent.model.num_timesteps:,} steps"
    print(f"{path}: {agent.path} after {steps}; {', '.join(contract['file']['operators'])}")
    print(f"{path.with_name(onnx_file.CONTRACT)} describes input and output")
    print(evaluation)
    return 0


main = command(Flags, export_agent)

if __name__ == "__main__":
    sys.exit(main())
