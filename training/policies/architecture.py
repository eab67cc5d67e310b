"""Architecture of a Stable-Baselines3 policy: what has to be known besides the weights to make it again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from leapnav.envs.utils.validation import check_choice
from leapnav.training.policies.actors import parts_of_dict
from leapnav.training.policies.navigation_policy import (
    MomentumSACPolicy,
    NavigationPolicy,
    components_of,
    has_momentum,
    symmetries_of,
)
from leapnav.training.policies.network import NavigationFeatures, check_spaces
from leapnav.training.policies.symmetries import Transformation

KINDS = ("actor-critic", "sac", "td3", "tqc")
EXTRACTORS = {"navigation": NavigationFeatures, "flatten": FlattenExtractor, "combined": CombinedExtractor}
ACTIVATIONS = {kind.__name__: kind for kind in (nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.SiLU, nn.Sigmoid)}


@dataclass(frozen=True)
class Architecture:
    """The architecture of an `MlpPolicy` or `MultiInputPolicy`, as JSON values.

    Attributes:
        kind: "actor-critic" (PPO, A2C), "sac", "td3" (also DDPG) or "tqc".
        hidden, critic: widths of the hidden layers of the actor and of the critic.
        extractor: "navigation" (`NavigationFeatures`), "flatten" (the observation itself) or "combined" (the parts of
            an observation in a Dict).
        activation: name of the activation function in `torch.nn`.
        effort_weights: weights of a policy with momentum, see `leapnav.training.policies.navigation_policy`, or None.
        symmetries: transformations under which the actions are equivariant, see
            `leapnav.training.policies.symmetries`.
        components: number of components of the mixture, see `leapnav.training.policies.mixture`.

    """

    kind: str
    hidden: tuple[int, ...]
    critic: tuple[int, ...]
    extractor: str = "navigation"
    activation: str = "ReLU"
    effort_weights: tuple[float, ...] | None = None
    symmetries: tuple[Transformation, ...] = ()
    components: int = 1

    def make(self, observation_space: spaces.Box | spaces.Dict, action_space: spaces.Space) -> BasePolicy:
        """Create an untrained policy on the CPU.

        Raises:
            ModuleNotFoundError: a TQC policy needs the extra `contrib`.
            ValueError: an attribute is unknown, or the spaces do not fit the extractor or the symmetries.

        """
        check_choice("kind", self.kind, KINDS)
        check_choice("extractor", self.extractor, EXTRACTORS)
        check_choice("activation", self.activation, ACTIVATIONS)
        if self.extractor == "navigation":
            check_spaces(observation_space, action_space)
        if isinstance(observation_space, spaces.Dict) != (self.extractor == "combined"):
            raise ValueError(f"extractor: expected that of the observations, got {self.extractor!r}")
        arguments: dict[str, Any] = {
            "net_arch": {"pi": list(self.hidden), "vf": list(self.critic), "qf": list(self.critic)},
            "activation_fn": ACTIVATIONS[self.activation],
            "features_extractor_class": EXTRACTORS[self.extractor],
        }
        if self.effort_weights is not None:
            arguments["effort_weights"] = self.effort_weights
        if self.symmetries:
            arguments["symmetries"] = self.symmetries
        if self.components != 1:
            arguments["components"] = self.components
        for name in ("symmetries", "components"):
            if name in arguments and self.kind != "actor-critic":
                raise ValueError(f"{name}: expected none for a policy of kind {self.kind!r}")
        kind = _policy_class(self.kind, own=bool({"effort_weights", "symmetries", "components"} & set(arguments)))
        return kind(observation_space, action_space, lambda _: 3e-4, **arguments)

    @classmethod
    def of(cls, policy: BasePolicy) -> Architecture:
        """Return the architecture of a policy.

        Raises:
            ValueError: it is none of the supported ones; the message contains the part that is not.

        """
        kind = next((name for name in KINDS if _is_installed(name) and isinstance(policy, _policy_class(name))), None)
        if kind is None:
            raise ValueError(
                f"model: expected a policy of PPO, A2C, SAC, TD3, DDPG or TQC, got {type(policy).__name__}"
            )
        given: Any = policy
        if isinstance(policy.observation_space, spaces.Dict):
            parts_of_dict(policy.observation_space)
        extractor = _name_of("features extractor", EXTRACTORS, policy.features_extractor_class)
        activation = _name_of("activation function", ACTIVATIONS, given.activation_fn)
        if getattr(given, "use_sde", False):
            raise ValueError("model: expected a policy without state-dependent exploration, got use_sde=True")
        hidden, critic = widths(given.net_arch)
        weights = given.effort_weights if has_momentum(policy) else None
        return cls(kind, hidden, critic, extractor, activation, weights, symmetries_of(policy), components_of(policy))


def with_symmetries(policy: BasePolicy, symmetries: tuple[Transformation, ...]) -> BasePolicy:
    """Return a policy with the weights of another one, whose actions are equivariant under symmetries.

    Args:
        policy: a policy of PPO or A2C.
        symmetries: see `leapnav.training.policies.symmetries`.

    Raises:
        ValueError: the policy is of another algorithm, has an architecture that is not supported, or other
            observations.

    """
    observation_space: Any = policy.observation_space
    symmetric = replace(Architecture.of(policy), symmetries=symmetries).make(observation_space, policy.action_space)
    symmetric.load_state_dict(policy.state_dict())
    symmetric.set_training_mode(False)
    return symmetric


def widths(net_arch: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the widths of the hidden layers of actor and critic in a `net_arch` of Stable-Baselines3.

    Raises:
        ValueError: it has another form.

    """
    parts = net_arch if isinstance(net_arch, Mapping) else {"pi": net_arch, "qf": net_arch}
    actor, critic = parts.get("pi", ()), parts.get("qf", parts.get("vf", ()))
    for part in (actor, critic):
        if not isinstance(part, (list, tuple)) or not all(isinstance(width, int) and width > 0 for width in part):
            raise ValueError(f"model: net_arch: expected lists of widths, got {net_arch!r}")
    return tuple(actor), tuple(critic)


def is_actor_weight(name: str) -> bool:
    """Return whether a weight belongs to the mean action or its noise."""
    return name.startswith(("actor.", "mlp_extractor.policy_net.", "action_net.", "log_std"))


def _name_of(what: str, known: Mapping[str, type], value: object) -> str:
    name = next((name for name, kind in known.items() if kind is value), None)
    if name is None:
        names = ", ".join(kind.__name__ for kind in known.values())
        raise ValueError(
            f"model: {what}: expected one of {names}, got {getattr(value, '__name__', value)}; a model with another "
            "one is saved by its method `save`"
        )
    return name


def _is_installed(kind: str) -> bool:
    return kind != "tqc" or find_spec("sb3_contrib") is not None


def _policy_class(kind: str, *, own: bool = False) -> Any:
    """Return the class of a kind of policies, with momentum, symmetries or a mixture the one of leapnav."""
    if own:
        return {"actor-critic": NavigationPolicy, "sac": MomentumSACPolicy}[kind]
    if kind == "tqc":
        from sb3_contrib.tqc.policies import TQCPolicy  # from the extra `contrib`

        return TQCPolicy
    return {"actor-critic": ActorCriticPolicy, "sac": SACPolicy, "td3": TD3Policy}[kind]
