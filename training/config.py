"""Settings of the training runs: plain data, so that the command line can show them without loading torch."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class CloningConfig:
    """Settings of behaviour cloning."""

    epochs: int = 12
    """Passes over the demonstrations."""
    batch_size: int = 1024
    """Samples per gradient step."""
    learning_rate: float = 1e-3
    """Peak of the learning rate, which then falls to zero along a cosine."""
    weight_decay: float = 1e-4
    """Of AdamW."""
    validation_share: float = 0.05
    """Share of the scenarios that is held out to measure the loss."""
    augment: bool = True
    """Use the mirrored and the turned-round twin of each sample too."""
    seed: int = 0
    """Of the split, the order of the samples and the twins."""
