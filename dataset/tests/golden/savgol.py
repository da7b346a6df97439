"""Makes savgol.csv: known values of scipy.signal.savgol_filter. Needs numpy and scipy; run it in this folder."""

import math

from scipy.signal import savgol_filter

x = [round(2.5 + 2 * math.sin(0.37 * i) + 0.5 * math.cos(2.9 * i) + (3.0 if i == 21 else 0.0), 6) for i in range(40)]
with open("savgol.csv", "w", encoding="utf-8") as out:
    out.write("# first line: the samples; then window: smoothed values, order 3, mode interp\n")
    out.write(",".join(repr(v) for v in x) + "\n")
    for window in (5, 7, 9, 15, 31, 39):
        out.write(f"{window}: " + ",".join(repr(float(v)) for v in savgol_filter(x, window, 3)) + "\n")
