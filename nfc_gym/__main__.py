"""`python -m nfc_gym` is `nfc-gym`."""

from nfc_gym.cli import main

if __name__ == "__main__":  # processes that are spawned import this file too
    main()
