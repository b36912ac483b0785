"""Where the files of settings are: ``hyperparams/``. Nothing heavy is imported here, they can be listed at once."""

from pathlib import Path

PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
# inside an installed wheel, or beside the package in a source checkout
HYPERPARAMS_FOLDERS = (PACKAGE_FOLDER / "hyperparams", PACKAGE_FOLDER.parent / "hyperparams")


def preset_names() -> list[str]:
    """Of the files in the package."""
    return sorted({path.stem for folder in HYPERPARAMS_FOLDERS for path in folder.glob("*.yml")})


def preset_path(name: str) -> Path:
    """Where the preset of a name, or a path ending in ``.yml`` or ``.yaml``, is."""
    if Path(name).suffix in (".yml", ".yaml"):
        if not Path(name).is_file():
            raise FileNotFoundError(f"no preset file at {name}")
        return Path(name)
    for folder in HYPERPARAMS_FOLDERS:
        if (folder / f"{name}.yml").is_file():
            return folder / f"{name}.yml"
    raise FileNotFoundError(f"no preset {name!r}: expected one of {', '.join(preset_names())}, or a path ending in .yml")
