"""One thread for torch in every test: results and times do not depend on the machine's cores."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def _one_torch_thread() -> None:
    import torch

    torch.set_num_threads(1)
