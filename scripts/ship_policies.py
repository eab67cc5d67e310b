"""Puts policies of finished runs into the package: `ship_policies.py RUN...`, each becomes that of its family.

What ships is the actor alone in half precision; `policy.json` has the settings that `leapnav train` made it with, and
docs/training.md the commands.
"""

import sys

from leapnav.training.policies import SHIPPED, load_policy, read_description, save_policy


def main() -> None:
    for run in sys.argv[1:]:
        training = read_description(run)["training"]
        family = training["family"]
        save_policy(load_policy(run), SHIPPED / family, training=training, half=True)
        size = sum(path.stat().st_size for path in (SHIPPED / family).iterdir())
        print(f"{SHIPPED / family}: {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
