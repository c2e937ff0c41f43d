"""Draw the robot at the end of some runs on terrain, on one sheet.

python docs/tools/terrains.py docs/terrains.png RUN ...
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageDraw

from clamber.run.folder import load_rollout
from clamber.show.marks import font
from clamber.show.pictures import render_frame

SIZE = (320, 250)
COLUMNS = 5
BAND = 22  # [px] for the name under a picture


def main(out: Path, runs: list[Path]) -> None:
    """One picture a run, in rows."""
    rows = -(-len(runs) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * SIZE[0], rows * (SIZE[1] + BAND)), "white")
    draw = ImageDraw.Draw(sheet)
    for i, run in enumerate(runs):
        end = float(load_rollout(run, with_events=False).time[-1])
        frame = render_frame(
            run, end, out=run / "end.png", size=SIZE, marks="none", camera="corner"
        )
        x, y = i % COLUMNS * SIZE[0], i // COLUMNS * (SIZE[1] + BAND)
        with Image.open(frame) as picture:
            sheet.paste(picture, (x, y))
        draw.text((x + 8, y + SIZE[1] + 3), run.name, font=font(14), fill="#333333")
    sheet.quantize(128, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python terrains.py SHEET.png RUN ...")
    main(Path(sys.argv[1]), [Path(a) for a in sys.argv[2:]])
