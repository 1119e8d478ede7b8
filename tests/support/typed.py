"""Commands as tests type them: a small training, a refusal, a film where one can be made."""

import pytest

from sb3_guard import train

TOY = "--gym-packages registered_envs --env CostPoint-v0".split()


SMALL = (
    "-params n_envs:2 n_steps:30 n_critic_updates:3 cost_limit:2 --seed 3 --device cpu "
    "--eval-freq 60 --eval-episodes 2"
).split()


LENGTH = ["--env-kwargs", "episode_length:20"]


PLAY = ["--env", "Filmed-v0", "--gym-packages", "registered_envs", "--no-render"]


def trained(folder, *arguments: str, algo: str = "cpo", env: str = "CostPoint-v0"):
    """Train for two rollouts; the run folder."""
    run = ["--algo", algo, *TOY, *SMALL, "-n", "120", "-f", str(folder), "--env", env, *arguments]
    if "Hazards" not in env:
        run += LENGTH
    assert train.main([*run, "--verbose", "0"]) == 0
    return max((folder / algo).glob(f"{env}_*"), key=lambda path: path.stat().st_mtime_ns)


def refused(main, arguments, capsys, *parts: str, status: int = 2) -> str:
    """Run a command that must fail as it should; its message."""
    returned = main(arguments)
    out, err = capsys.readouterr()
    assert returned == status, out + err
    message = err.splitlines()[-1]
    assert message.startswith("error: ")
    assert "Traceback" not in err + out
    assert err.count("error:") == 1
    for part in parts:
        assert part in message, message
    return message


def require_rendering():
    from sb3_guard.envs.rendering import RenderingError, gl_backend

    try:
        gl_backend()
    except RenderingError as error:
        pytest.skip(str(error))
