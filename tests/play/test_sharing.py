"""Datasets are shared by Minari's own upload, here to a directory instead of the Hugging Face Hub."""

import json
import shutil
from pathlib import Path

import minari
import pytest
from minari.storage import remotes
from minari.storage.datasets_root_dir import get_dataset_path
from minari.storage.remotes.cloud_storage import CloudStorage

from leapnav.experts import rollout

NAMESPACE, DATA, METADATA = "namespace_metadata.json", "data/main_data.hdf5", "data/metadata.json"


class Directory(CloudStorage):
    """A remote storage of Minari in a directory."""

    def __init__(self, name, token):
        self.root = Path(f"/{name}")

    def upload_dataset(self, dataset_id):
        shutil.copytree(get_dataset_path(dataset_id), self.root / dataset_id)

    def upload_namespace(self, namespace):
        (self.root / namespace).mkdir(parents=True, exist_ok=True)
        shutil.copy(get_dataset_path(namespace) / NAMESPACE, self.root / namespace)

    def list_datasets(self, prefix=None):
        return [str(path.parents[1].relative_to(self.root)) for path in self.root.rglob(DATA)]

    def list_namespaces(self):
        return [str(path.parent.relative_to(self.root)) for path in self.root.rglob(NAMESPACE)]

    def get_dataset_metadata(self, dataset_id):
        return json.loads((self.root / dataset_id / METADATA).read_text())

    def download_dataset(self, dataset_id, path):
        shutil.copytree(self.root / dataset_id, Path(path) / dataset_id)

    def download_namespace_metadata(self, namespace, path):
        (Path(path) / namespace).mkdir(parents=True, exist_ok=True)
        shutil.copy(self.root / namespace / NAMESPACE, Path(path) / namespace)


@pytest.fixture
def storage(tmp_path, monkeypatch):
    monkeypatch.setitem(remotes._registry, "directory", lambda: Directory)
    monkeypatch.setenv("MINARI_REMOTE", f"directory:/{tmp_path}/remote")
    (tmp_path / "remote").mkdir()


def test_a_dataset_is_uploaded_and_downloaded_by_minari(storage, tmp_path, monkeypatch):
    rollout("open", 3, tmp_path / "demos", progress=False)
    name = "leapnav/open/expert-v0"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "demos"))
    ours = minari.load_dataset(name)
    minari.upload_dataset(name, "token")
    assert list(minari.list_remote_datasets()) == [name]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "downloads"))
    minari.download_dataset(name)
    theirs = minari.load_dataset(name)
    assert theirs.total_episodes == ours.total_episodes == 3 and theirs.total_steps == ours.total_steps
    assert (theirs[2].observations == ours[2].observations).all()
