"""What logs from which a rest was subtracted cannot tell, with their sign or without it."""

__all__ = ["untold"]


def untold(unit: str) -> list[str]:
    """What a log in a unit of `recordings.UNITS` cannot tell, in words; nothing of raw counts."""
    if unit == "counts":
        return []
    out = [
        f"the electrodes are {unit}, their rest is assumed: the ends of the converter, words that overflow, "
        "exchanges and cross-talk told by levels, noise of all electrodes and a low-pass from the first row, "
        "gain and offset of all against a warm-up, the amended sensor's rest"
    ]
    if unit.endswith("without sign"):
        out.append(
            "the electrodes have no sign: the sign of an electrode, wiring that is wrong all the time, "
            "hysteresis, lost liquid against a warm-up, a lower limit"
        )
    return out
