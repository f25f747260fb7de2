"""PPO over several ranks that is the PPO of one process with all environments."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from torch import Tensor

from wbm.learning.team import Team


class TeamGaussian(GaussianDistribution):
    """Draws the actions of all ranks and keeps this rank's, so that all ranks' random states stay alike.

    Attributes:
        total: rows of all ranks; `mine`: which of them are here.
    """

    total: int = 0
    mine: slice | Tensor = slice(None)

    def sample(self) -> Tensor:
        """Actions of this rank's rows."""
        mean, std = self.mean, self.std
        noise = torch.randn(self.total, mean.shape[1], device=mean.device)[self.mine]
        return noise * std + mean


class TeamPPO(PPO):
    """The update of rsl_rl's PPO with every mean taken over the samples of all ranks.

    A minibatch is drawn over all ranks; a rank works on the samples of it that are its own, few or many, divides by the
    size of the whole minibatch, and the gradients are summed. Advantages are normalised over all ranks.

    Args:
        team: the ranks; the other arguments are PPO's. Recurrent networks, symmetry and curiosity are not offered.
    """

    def __init__(self, actor, critic, storage: RolloutStorage, *, team: Team, **settings) -> None:
        super().__init__(actor, critic, storage, **settings)
        self.team = team
        self._noise: TeamGaussian = actor.distribution
        self._whole_step()

    def _whole_step(self) -> None:
        count = self.storage.num_envs
        self._noise.total, self._noise.mine = count * self.team.size, self.team.rows(count)

    def compute_returns(self, obs) -> None:
        """Returns, and advantages with mean 0 and deviation 1 over all ranks."""
        super().compute_returns(obs)
        st = self.storage
        raw = st.returns - st.values
        count = raw.numel() * self.team.size
        mean = self.team.sum(raw.sum()) / count
        variance = self.team.sum((raw - mean).square().sum()) / (count - 1)
        st.advantages = (raw - mean) / (variance.sqrt() + 1e-8)

    def update(self) -> dict[str, float]:
        """One pass of epochs and minibatches; returns the mean losses."""
        st, sums = self.storage, torch.zeros(3)
        old = [p.flatten(0, 1) for p in st.distribution_params or ()]
        data = [t.flatten(0, 1) for t in (st.actions, st.actions_log_prob, st.values, st.returns, st.advantages)]
        observations = st.observations.flatten(0, 1)
        for own, size, places in self._minibatches():
            actions, old_log_prob, old_value, returns, advantage = (t[own] for t in data)
            self._noise.total, self._noise.mine = size, places
            self.actor(observations[own], stochastic_output=True)
            log_prob = self.actor.get_output_log_prob(actions)
            value = self.critic(observations[own])
            if self.schedule == "adaptive":
                with torch.no_grad():
                    new = self.actor.output_distribution_params
                    divergence = self.actor.get_kl_divergence(tuple(p[own] for p in old), new)
                self._adapt(float(self.team.sum(divergence.sum()) / size))

            # Losses: sums over this rank's samples, over the size of the whole minibatch
            ratio = (log_prob - old_log_prob.squeeze(1)).exp()
            gain = advantage.squeeze(1)
            clipped = ratio.clamp(1 - self.clip_param, 1 + self.clip_param)
            surrogate = -torch.min(gain * ratio, gain * clipped).sum() / size
            error = (value - returns).square()
            if self.use_clipped_value_loss:
                near = old_value + (value - old_value).clamp(-self.clip_param, self.clip_param)
                error = torch.max(error, (near - returns).square())
            value_loss = error.sum() / size
            entropy = self.actor.output_entropy.sum() / size
            loss = surrogate + self.value_loss_coef * value_loss - self.entropy_coef * entropy

            self.optimizer.zero_grad()
            loss.backward()
            self._sum_gradients()
            torch.nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
            torch.nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
            self.optimizer.step()
            sums += torch.stack([value_loss, surrogate, entropy]).detach().cpu()
        self._whole_step()
        for network in (self.actor, self.critic):
            network.update_normalization(observations)  # rsl_rl sums these over the process group by itself
        st.clear()
        means = self.team.sum(sums) / (self.num_learning_epochs * self.num_mini_batches)
        return dict(zip(("value", "surrogate", "entropy"), means.tolist(), strict=True))

    def _minibatches(self) -> Iterator[tuple[Tensor, int, Tensor]]:
        """Rows of this rank's samples in each minibatch, the size of the whole, and the rows' places in it.

        A sample of all ranks has the number `step * (R N) + rank * N + environment`, as with one process. The epochs
        share one permutation, as rsl_rl's do.
        """
        count = self.storage.num_envs
        wide = count * self.team.size
        size = wide * self.storage.num_transitions_per_env // self.num_mini_batches
        order = torch.randperm(self.num_mini_batches * size, device=self.device)
        for _ in range(self.num_learning_epochs):
            for chosen in order.split(size):
                env = chosen % wide - self.team.rank * count
                places = ((env >= 0) & (env < count)).nonzero().squeeze(1)
                yield (chosen // wide * count + env)[places], size, places

    def _adapt(self, divergence: float) -> None:
        """Lower or raise the learning rate so that the policy's step is about `desired_kl` long."""
        if divergence > 2 * self.desired_kl:
            self.learning_rate = max(1e-5, self.learning_rate / 1.5)
        elif 0 < divergence < self.desired_kl / 2:
            self.learning_rate = min(1e-2, self.learning_rate * 1.5)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate

    def _sum_gradients(self) -> None:
        """Add up the ranks' gradients in one message."""
        gradients = [p.grad for group in self.optimizer.param_groups for p in group["params"] if p.grad is not None]
        total = self.team.sum(torch.cat([g.flatten() for g in gradients]))
        for gradient, part in zip(gradients, total.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(part.view_as(gradient))
