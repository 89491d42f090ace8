"""Planted mistakes that change no result, judged one by one; `scripts.check.mutants` leaves them out of its shares.

By the key of `scripts.check.mutations.Site`: a change of the code around such a mistake brings it back.
"""

from __future__ import annotations

HARMLESS = {
    "cc931d9fd18dd576": "`repr` or `compare` of a field that follows from the others",
    "b0297d28c7fdb75f": "how finely a start of Newton's method is tabulated",
    "1861c5cc51a9507f": "a cell is cut in unequal parts that still cover it: the proof takes longer",
    "c1c0d87e7ed882a1": "a number that stands where it is not read",
    "b65b2b83af420b66": "cells without spaces are stripped: only time",
    "b32215be7946701c": "zero times a number, added or subtracted",
    "4beb85845d5b49a6": "a number that is set again before it is read",
    "ffa3e8654c336e29": "a row of nodes more, beyond the image",
    "7900d21ef92672db": "a number that stands where it is not read",
    "2166b957298e0a07": "how coordinates lie in memory: only time",
    "76620474b9ce23e3": "by what a covariance is divided where a variance is zero: how much rounding is let through",
    "4ba3346cb1ac1a53": "rounds more than are needed where pixels are not square",
    "901479ab88fb1d4e": "where a search of amplitudes begins",
    "24324b097f27a6bd": "the rows without one more, of which the pupil's are none",
    "622e793a3790f775": "fy for fx of a camera with square pixels",
    "eb5d59136d2feaa9": "where a thing stands on a site that is made up",
    "3fd88ae2dcad7243": "compares no elements at all",
    "5ffe52c4f8d4ca51": "random numbers that nothing reads: other draws of the same kind",
    "3bfb151f959b9181": "where a thing stands on a site that is made up",
    "cdd6206bf027eb13": "how finely the truth is tabulated",
    "de053044b2589680": "when stopped elements are dropped from a batch: only time",
    "e0ea7adc7be67053": "how many steps a search may take that ends long before",
    "919fd48b3143c8b7": "a number, from the same factors in another order",
    "0596630b21cb4ec2": "a number, from the same factors in another order",
    "ab8b1729821ccfe0": "a first focal length, from which a fit begins",
    "02a20fa8d7b5185d": "where a thing stands on a site that is made up",
    "96a90b97a1771eed": "a variance that is zero to the last bit",
    "921b63f435eb9d99": "whether two texts are equal, whichever comes first",
    "3b10bbfa613c0d36": "lines of a log below the level that is shown",
    "ed7dec0d6447abef": "when stopped elements are dropped from a batch: only time",
    "e7fec4571310adb3": "what happens when no port is free, and there always is one",
    "9d350f625c8848c9": "a negative number, which means none whatever its size",
}
