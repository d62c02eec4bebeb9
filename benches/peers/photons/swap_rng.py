#!/usr/bin/env python3
"""swap_rng.py mcmlgo.c: replaces the body of RandomNum() (ran3 of Numerical Recipes) by xoshiro256+, in place. A test of the generator."""
import sys
p = sys.argv[1]
s = open(p, newline="").read().replace("\r\n", "\n")
i = s.index("double RandomNum(void)\n{")
j = s.index("}\n\n/****", i)
s = s[:i] + '''#include <stdint.h>
#include <unistd.h>
static uint64_t xs[4];
double RandomNum(void)
{
  static int first = 1;
  uint64_t r, t;
  if (first) {
    uint64_t z = (uint64_t)time(NULL)*1000003u + getpid(), q;
    int i;
    first = 0;
    for (i = 0; i < 4; i++) {
      q = z += 0x9e3779b97f4a7c15ull;
      q = (q ^ (q >> 30))*0xbf58476d1ce4e5b9ull;
      q = (q ^ (q >> 27))*0x94d049bb133111ebull;
      xs[i] = q ^ (q >> 31);
    }
  }
  r = xs[0] + xs[3];
  t = xs[1] << 17;
  xs[2] ^= xs[0]; xs[3] ^= xs[1]; xs[1] ^= xs[2]; xs[0] ^= xs[3];
  xs[2] ^= t;
  xs[3] = (xs[3] << 45) | (xs[3] >> 19);
  return (r >> 11)*0x1.0p-53;
''' + s[j:]
open(p, "w", newline="").write(s)
