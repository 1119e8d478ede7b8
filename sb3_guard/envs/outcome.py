"""What one control step brings, for the gymnasium classes to hand on."""

from dataclasses import dataclass

from sb3_guard.envs.types import Array


@dataclass
class Outcome:
    """What one control step brought to each row.

    :param obs: observation, [N, D] float32
    :param reward: [N]
    :param costs: cost per constraint type, [N] each, under the names of their info keys
    :param cost: the sum of the costs, [N]
    :param goal_met: whether the goal was reached in this step, [N] bool
    :param terminated: a part ended the episode, the goal was its end or the physics diverged,
        [N] bool
    :param ended_by: by a part's name, the rows that it was the first to end, [N] bool each
    :param unplaced: no room was left for the next goal: the episode is to be cut, [N] bool
    :param physics_error: the physics diverged, [N] bool
    :param drawn: parameters drawn for the episodes, by name, [N] each, if asked for
    """

    obs: Array
    reward: Array
    costs: dict[str, Array]
    cost: Array
    goal_met: Array
    terminated: Array
    unplaced: Array
    physics_error: Array
    ended_by: dict[str, Array]
    drawn: dict[str, Array]

    def forget(self, rows: list[int]) -> None:
        """Nothing happened in these rows, which took no step."""
        for amounts in (self.reward, self.cost, *self.costs.values()):
            amounts[rows] = 0.0
        ends = self.terminated, self.unplaced, *self.ended_by.values()
        for happened in (self.goal_met, self.physics_error, *ends):
            happened[rows] = False

    @property
    def details(self) -> dict[str, Array]:
        """What info says of every row in addition to the cost, by key, [N] each."""
        return {**self.costs, **self.drawn}

    @property
    def events(self) -> dict[str, Array]:
        """What info says of the rows in which it happened, by key, [N] bool each."""
        return {
            "goal_met": self.goal_met,
            "goal_unplaced": self.unplaced,
            "physics_error": self.physics_error,
        }
