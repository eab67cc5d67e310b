"""The construction of proofs of lower bounds; `leapnav.experts.proofs` checks them."""
