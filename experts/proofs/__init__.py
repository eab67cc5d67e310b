"""Proofs of lower bounds and their checker, which does not depend on how a proof was found."""
