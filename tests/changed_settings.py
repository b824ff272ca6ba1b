"""Compare two configurations setting by setting."""

from sigmasplat.config import Config


def changed_settings(a: Config, b: Config) -> set[str]:
    """Return the names SECTION.NAME of the settings in which two configurations differ."""
    ours, theirs = a.to_dict(), b.to_dict()
    return {
        f"{section}.{name}"
        for section, values in ours.items()
        if isinstance(values, dict)
        for name, value in values.items()
        if theirs[section][name] != value
    }
