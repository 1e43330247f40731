"""Neural fidelity calibration: from a window of motion to a posterior over psi, residual dynamics and terrain."""

try:
    import safetensors  # noqa: F401
    import torch  # noqa: F401
except ImportError as e:
    from nfc_gym.core.errors import MissingExtra

    raise MissingExtra(f"nfc_gym.inference needs {e.name}: pip install 'nfc_gym[inference]'") from None
