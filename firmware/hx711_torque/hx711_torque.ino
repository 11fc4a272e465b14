// Load cell of the torque rig: an HX711 on an Arduino Uno, raw counts as one decimal a line, 115200 baud.
//
// Wiring
//   HX711        Arduino Uno           HX711        load cell
//   VCC          5V                    E+           red
//   GND          GND                   E-           black
//   DT  (DOUT)   pin 3                 A+           green
//   SCK          pin 2                 A-           white
// The RATE pin of the HX711 stays low, as most boards have it: 10 samples a second, nominally (the clock is the
// converter's own; real boards send 10 to 11 lines a second). Swapped signal wires only turn the sign, which the
// calibration finds out. Keep the cell's wires short and twisted, and their shield on the HX711's side only.
//
// What is sent: for each conversion its 24-bit value in two's complement, -8388608 to 8388607, and a line end. No
// tare and no scale: these are the host's business (`shearloop calibrate load`), so that a reset of the board, which
// opening the port causes, changes nothing. The ends of the range mean that the converter is saturated.
// While the converter is not ready (no power, a loose wire) nothing is sent, and the host reports the silence.

const uint8_t PIN_SCK = 2;
const uint8_t PIN_DT = 3;
// 25 to 27 pulses choose what is converted next; 25: channel A with gain 128 (±20 mV at 5 V).
const uint8_t EXTRA_PULSES = 1;

void setup() {
  pinMode(PIN_SCK, OUTPUT);
  digitalWrite(PIN_SCK, LOW);
  // With the pull-up a wire that is off reads "not ready" instead of noise.
  pinMode(PIN_DT, INPUT_PULLUP);
  Serial.begin(115200);
  readCounts();  // the conversion that was under way when the gain was not yet chosen
}

void loop() {
  Serial.println(readCounts());
}

// Waits for the end of a conversion and returns it.
int32_t readCounts() {
  while (digitalRead(PIN_DT) == HIGH) {
  }
  uint32_t bits = 0;
  // SCK high for more than 60 µs switches the converter off: no interrupt may come between the two edges.
  for (uint8_t n = 0; n < 24; n++) {
    bits = bits << 1 | pulse();
  }
  for (uint8_t n = 0; n < EXTRA_PULSES; n++) {
    pulse();
  }
  // The sign is bit 23.
  if (bits & 0x800000UL) {
    bits |= 0xFF000000UL;
  }
  return (int32_t)bits;
}

// Clocks one bit out, most significant first, and returns it.
uint8_t pulse() {
  noInterrupts();
  digitalWrite(PIN_SCK, HIGH);
  delayMicroseconds(1);
  uint8_t bit = digitalRead(PIN_DT);
  digitalWrite(PIN_SCK, LOW);
  interrupts();
  delayMicroseconds(1);
  return bit;
}
