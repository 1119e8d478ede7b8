"""``sb3-guard show go1.xml`` tries a robot's file before it is registered."""

import re

import pytest
from robot_models import ARM, DOG
from worlds import own_parts

from sb3_guard import show


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_dog.xml").write_text(DOG.format(keys=""))
    (tmp_path / "crane.xml").write_text(ARM)
    (tmp_path / "dog.urdf").write_text('<robot name="dog"/>')

    def call(*words):
        with own_parts():
            try:
                status = show.main([*words, "-o", "picture.png"])
            except SystemExit as end:
                status = end.code
        out, err = capsys.readouterr()
        return status, out, err

    return call


def test_it_prints_what_was_taken_from_the_file_and_draws_it(run, tmp_path):
    stated = ["actuators:{'kp': 40, 'kd': 2}", "root:'trunk'", "action:'offset'"]
    status, out, _ = run("my_dog.xml", "--robot-kwargs", *stated)
    assert status == 0 and (tmp_path / "picture.png").is_file()
    assert "sb3_guard.register_robot('Mydog', xml='my_dog.xml', actuators={'kp': 40" in out
    for row in (
        "| outermost body       | trunk ",
        "| left out of the file | body ball, geom ground, sensor to_ball |",
        "| front_calf  | [-2.62, -0.524] | -1.57 ",
        "| 1      | front_calf  | [-1, 1] | [-1.8208, -1.3208]",
    ):
        assert row in out


def test_an_arm_says_how_far_it_reaches(run):
    words = ["actuators:{'kp': 40, 'kd': 2}", "center:'hand'"]
    status, out, _ = run("crane.xml", "--robot-kwargs", *words)
    assert status == 0 and "| reach                | 0.5" in out
    assert "none, it stands on a fixed base" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["crane.xml"], "crane.xml has no actuators: give its joints position servos, actuators="),
        (["dog.urdf"], "dog.urdf is URDF, not MJCF: convert it once with"),
        (["none.xml"], "there is no file 'none.xml'"),
        (["my_dog.xml"], "2 outermost bodies with joints, 'trunk', 'ball': .* root='trunk'"),
        (["Goal_Ant_8Hazards", "--robot-kwargs", "action:'offset'"], "goes with a robot's file"),
        (["crane.xml", "--robot-kwargs", "colour:3"], "robot 'Crane' has no 'colour': "),
    ],
)
def test_a_file_that_is_no_robot_yet_is_answered_in_a_line(run, words, message):
    status, _, err = run(*words)
    assert status not in (0, None)
    assert re.search(message, err) and len(err.strip().splitlines()) == 1
