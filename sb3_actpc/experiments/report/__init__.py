"""Tables, figures and statistics made from the folders of runs."""

from sb3_actpc.utils.extras import import_extra

for _module in ("pandas", "scipy", "matplotlib"):
    import_extra(_module, "experiments")
