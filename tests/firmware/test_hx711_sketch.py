"""The Arduino sketch, compiled for this computer against a played converter that keeps the data sheet's timing."""

import shutil
import subprocess
from pathlib import Path

import pytest

from shearloop.drivers.load_cell import COUNTS_MAX, COUNTS_MIN, LoadCalibration, LoadParser

SKETCH = Path(__file__).resolve().parents[2] / "firmware/hx711_torque/hx711_torque.ino"

# The Arduino's functions, and the converter behind two pins (HX711 data sheet, "Serial interface"): DT falls when a
# conversion is ready, each rising edge of SCK puts out a bit, most significant first, the 25th raises DT again. A
# program that breaks the rules ends with a number of its own.
ARDUINO = r"""
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#define HIGH 1
#define LOW 0
#define OUTPUT 1
#define INPUT_PULLUP 2
static long conversion; static int pulses = 25, sck = 0, interrupts_on = 1, polls = 0, baud = 0, sck_is_output = 0;
static void next() {
  if (!(std::cin >> conversion)) std::exit(0);
  pulses = 0; polls = 0;
}
void pinMode(uint8_t pin, uint8_t mode) { if (pin == 2) sck_is_output = mode == OUTPUT; }
void noInterrupts() { interrupts_on = 0; }
void interrupts() { if (sck) std::exit(11); interrupts_on = 1; }
void delayMicroseconds(unsigned) {}
void digitalWrite(uint8_t pin, uint8_t level) {
  if (pin != 2 || !sck_is_output) std::exit(12);
  if (level && !sck) {
    if (interrupts_on) std::exit(13);
    if (pulses >= 25) std::exit(14);
    pulses++;
  }
  sck = level;
}
int digitalRead(uint8_t pin) {
  if (pin != 3) std::exit(15);
  if (pulses == 0) return LOW;
  if (pulses <= 24) return conversion >> (24 - pulses) & 1;
  if (!sck && ++polls > 3) { next(); return LOW; }
  return HIGH;
}
struct { void begin(long b) { baud = b; }
         void println(long v) { if (baud != 115200) std::exit(16); std::printf("%ld\r\n", v); } } Serial;
int32_t readCounts();
uint8_t pulse();
#include SKETCH
int main() { setup(); for (;;) loop(); }
"""


def test_the_sketch_reads_the_converter_and_speaks_the_drivers_language(tmp_path):
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("needs g++ to compile the sketch for this computer")
    (tmp_path / "harness.cpp").write_text(ARDUINO)
    program = tmp_path / "sketch"
    include = f'-DSKETCH="{SKETCH}"'
    subprocess.run(
        [compiler, "-Wall", "-Wextra", "-Werror", include, "-o", program, tmp_path / "harness.cpp"], check=True
    )
    counts = [0, 1, -1, 8000, -81234, COUNTS_MAX, COUNTS_MIN, 0x555555, -0x555556]
    # The first conversion was made before the gain was chosen, and is not sent.
    given = "\n".join(map(str, [123, *counts]))
    done = subprocess.run([program], input=given, capture_output=True, text=True, timeout=10, check=True)
    parser = LoadParser(LoadCalibration.of_torque_lines())
    samples = parser.feed(done.stdout.encode(), 0)
    assert [sample.raw for sample in samples] == counts
    assert [sample.saturated for sample in samples] == [count in (COUNTS_MAX, COUNTS_MIN) for count in counts]
    assert not parser.errors
