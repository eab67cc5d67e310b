"""Write the tables of the studies into the documentation, from the results that are stored with each study.

python scripts/write_tables.py          # writes the tables
python scripts/write_tables.py --check  # writes nothing; fails if a table is not that of the results

A study is a directory `studies/NAME` with a module `run.py`, whose `TABLES` names the file of each table and whose
`tables(results)` returns their text. In the file, a table is between the lines `<!-- table: NAME -->` and
`<!-- end of table -->`.
"""

import argparse
import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]


def load_study(folder: Path) -> ModuleType:
    """Import the module of a study."""
    specification = importlib.util.spec_from_file_location(f"study_{folder.name}", folder / "run.py")
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    return module


def with_table(text: str, name: str, table: str) -> str:
    """Return a text with another table.

    Raises:
        ValueError: the text has no place for the table.

    """
    pattern = re.compile(rf"(<!-- table: {re.escape(name)} -->\n).*?(<!-- end of table -->\n)", re.DOTALL)
    changed, count = pattern.subn(lambda found: f"{found[1]}\n{table}\n{found[2]}", text)
    if count != 1:
        raise ValueError(f"table {name}: expected one place for it, found {count}")
    return changed


def main() -> None:
    """Write the tables, or compare them with those in the documentation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a table differs")
    arguments = parser.parse_args()
    different = []
    for folder in sorted(path.parent for path in (ROOT / "studies").glob("*/run.py")):
        study = load_study(folder)
        for name, table in study.tables(folder / "results").items():
            path = ROOT / study.TABLES[name]
            text = path.read_text(encoding="utf-8")
            changed = with_table(text, name, table)
            if changed != text:
                different.append(name)
                if not arguments.check:
                    path.write_text(changed, encoding="utf-8")
    if arguments.check and different:
        sys.exit(f"differ from the results: {', '.join(different)}; run python scripts/write_tables.py")
    print(f"wrote {', '.join(different)}" if different else "all tables are those of the results")


if __name__ == "__main__":
    main()
