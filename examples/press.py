"""A press from Python, and what comes out of it: python examples/press.py"""

from biotac_mj.press import PressOptions, press


def main(skin="default", depth=1.5e-3):
    record = press(
        PressOptions(indenter="cylinder_short_7mm", location=(-10e-3, 0.3), depth=depth, skin=skin)
    ).record
    change = record.electrode_change[-1]
    most = abs(change).argmax()
    print(
        f"force {record.force[-1].round(3)} N at {1e3 * record.depth[-1]:.2f} mm; "
        f"E{most + 1} changed most, by {change[most]:+.0f} counts"
    )
    return record


if __name__ == "__main__":
    main()
