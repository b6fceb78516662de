"""Three iterations of PPO in float64, by as many processes as torchrun starts: python joint_learning.py FOLDER.

Process r of n has environments r·16/n and so on of the same 16, draws the same actions in them as one process would, and takes
mini-batches whose union is that of one process. Each writes what it has learned to FOLDER/n_r.pt.
"""

import contextlib
import io
import sys
from pathlib import Path

import torch
from drifting_envs import Drifting

from tgdsl.rl.train.model import Gaussian
from tgdsl.rl.train.ppo import CapturedPPO
from tgdsl.rl.train.ranks import Ranks

ENVS, STEPS, BATCHES = 16, 6, 4


def config(ranks):
    encoders = {"*": {"hidden": [8], "size": 4}}
    model = {"class_name": "tgdsl.rl.train.model:EncodedModel", "hidden_dims": [8], "encoders": encoders}
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian", "init_std": 0.8}
    rnd = {"weight": 3.0, "num_outputs": 4, "predictor_hidden_dims": [8], "target_hidden_dims": [8]}
    rnd |= {"state_normalization": True, "reward_normalization": True}
    return {
        "num_steps_per_env": STEPS,
        "multi_gpu": ranks.rsl_rl,
        "obs_groups": {"actor": ["here", "there"], "critic": ["here", "there", "still"], "rnd_state": ["here"]},
        "actor": model | {"distribution_cfg": gaussian},
        "critic": model,
        "algorithm": {
            "class_name": "tgdsl.rl.train.ppo:CapturedPPO",
            "num_learning_epochs": 3,
            "num_mini_batches": BATCHES,
            "rnd_cfg": rnd,
            "max_grad_norm": 0.05,
        },
    }


def own_rows(ranks):
    """Return which environments are this process's."""
    each = ENVS // ranks.size
    return slice(ranks.rank * each, (ranks.rank + 1) * each)


def order(ranks, generator):
    """Return the order of this process's rows; mini-batches hold the same rows for any number of processes."""
    each, size = ENVS // ranks.size, STEPS * ENVS // BATCHES
    every = [torch.randperm(STEPS * ENVS // 2, generator=generator) for _ in range(2)]  # of each half of the environments
    found = []
    for i in range(BATCHES):
        for half, rows in enumerate(every):
            rows = rows[i * size // 2 : (i + 1) * size // 2]
            step, env = rows // (ENVS // 2), rows % (ENVS // 2) + half * ENVS // 2 - ranks.rank * each
            if ranks.size == 1 or half == ranks.rank:
                found.append(step * each + env)
    return torch.cat(found)


def main(folder: Path) -> None:
    ranks = Ranks.of()
    torch.set_default_dtype(torch.float64)
    ranks.join("cpu")
    noise, shuffled = torch.Generator().manual_seed(7), torch.Generator().manual_seed(8)

    def sample(self):
        return torch.randn((ENVS, 2), generator=noise)[own_rows(ranks)] * self.std + self.mean

    Gaussian.sample = sample
    env = Drifting(ENVS // ranks.size, own_rows(ranks).start, ENVS)
    torch.manual_seed(ranks.rank)  # networks of the first process are everybody's
    with contextlib.redirect_stdout(io.StringIO()):
        algorithm = CapturedPPO.construct_algorithm(env.get_observations(), env, config(ranks), "cpu")
    if ranks.size > 1:
        algorithm.broadcast_parameters()
    algorithm.train_mode()
    obs, rates = env.get_observations(), []
    for _ in range(3):
        for _ in range(STEPS):
            obs, reward, dones, extras = env.step(algorithm.act(obs))
            algorithm.process_env_step(obs, reward, dones, extras)
        algorithm.compute_returns(obs)
        rows = order(ranks, shuffled)
        torch.randperm, before = (lambda n, device=None, rows=rows: rows), torch.randperm
        algorithm.update()
        torch.randperm = before
        rates.append(algorithm.learning_rate)
    models = {"actor": algorithm.actor, "critic": algorithm.critic, "predictor": algorithm.rnd.predictor}
    models |= {"state": algorithm.rnd.state_normalizer, "reward": algorithm.rnd.reward_normalizer.emp_norm}
    learned = {f"{part}/{name}": value for part, model in models.items() for name, value in model.state_dict().items()}
    learned |= {"rates": torch.tensor(rates), "advantages": algorithm.storage.advantages, "pos": env.pos}
    torch.save(learned, folder / f"{ranks.size}_{ranks.rank}.pt")
    ranks.leave()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
