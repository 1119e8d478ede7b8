"""Certify a trained agent: ``sb3-guard certify --algo cpo --env Goal_Point_8Hazards``.

``sb3_guard.certify`` is the function that certifies a model, so that the command's module has
another name.
"""

import math
import sys
from contextlib import closing
from pathlib import Path

from sb3_guard.zoo.agents.flags import CertifyFlags as Flags
from sb3_guard.zoo.cli.flags import command


def certify_agent(flags: Flags) -> int:
    """Play an agent's fresh episodes and print what they show; 0 if it is certified, else 1."""
    from sb3_guard.common.certificate import certify
    from sb3_guard.common.files import replacing
    from sb3_guard.common.monitor import highest_costs
    from sb3_guard.judging import EPISODES
    from sb3_guard.zoo.agents.playback import open_agent
    from sb3_guard.zoo.cli.usage import UsageError, explained
    from sb3_guard.zoo.run.make_envs import BAD_NUMBERS
    from sb3_guard.zoo.run.run import CERTIFICATE_ENVS

    if flags.json:
        Path(flags.json).parent.mkdir(parents=True, exist_ok=True)
    agent = open_agent(flags, None, CERTIFICATE_ENVS)
    limits, most = flags.cost_limit, flags.most
    if flags.exact:
        limit_on = getattr(agent.model, "limit_on", "sum")
        most = max(highest_costs(agent.env, limit_on).values(), default=math.inf)
        if math.isinf(most):
            raise UsageError(f"{agent.env_id} does not state its highest cost; give it with --most")
    with closing(agent.env), explained(f"can't certify {agent.path}", ValueError, *BAD_NUMBERS):
        certificate = certify(
            agent.model,
            agent.env,
            limits[0] if len(limits) == 1 else limits or None,
            n_episodes=flags.n_episodes or EPISODES,
            deterministic=not agent.stochastic,
            seed=flags.seed,
            most=most,
        )
    print(f"{agent.path} on {agent.env_id}")
    print(certificate)
    if flags.json:
        with replacing(flags.json) as file:
            file.write(certificate.to_json().encode())
    return 0 if certificate.verdict == "certified" else 1


main = command(Flags, certify_agent)

if __name__ == "__main__":
    sys.exit(main())
