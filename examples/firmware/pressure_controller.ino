// A pressure controller of three chambers for surgisoft's line protocol, version 1.
//
// A reference sketch for a microcontroller with hardware serial, PWM outputs for proportional
// regulators and analogue inputs for their sensors (Arduino's API: Uno R4, Teensy, ESP32 and others).
// The protocol is documented in surgisoft/rig/drivers/line_protocol.py. No test needs this file; try it
// with the valves disconnected first, and check the scales below for your regulators and sensors.
//
// Safety: starts vented; clips every set point; vents by itself if no SET came for ventMs, and stays
// vented until ARM. Wire the regulators so that they vent without power, and add a valve by hand.

#include <Arduino.h>
#include <stdlib.h>
#include <string.h>

const int M = 3;                              // chambers
const int OUT[M] = {3, 5, 6};                 // PWM pins of the regulators
const int IN[M] = {A0, A1, A2};               // analogue pins of the pressure sensors
const float LOW_KPA = 0.0, HIGH_KPA = 50.0;   // limits of set points
const float FULL_SCALE_KPA = 100.0;           // regulator at full PWM duty
const float SENSOR_KPA_PER_COUNT = 100.0 / 1023.0;
const float SENSOR_ZERO_KPA = 0.0;
const unsigned long REPORT_MS = 20;           // 50 reports a second
const unsigned long LONGEST_MS = 5000;        // longest watchdog that WATCH may set

float target[M];
char state = 'I';                             // I idle, R running, H hold, T tripped
unsigned long seq = 0, lastSetMs = 0, lastReportMs = 0;
unsigned long holdMs = 300, ventMs = 1000;
char in[256];
int length = 0;

unsigned int crc16(const char *text, int n) { // CRC-16/CCITT-FALSE
  unsigned int crc = 0xFFFF;
  for (int i = 0; i < n; i++) {
    crc ^= (unsigned int)(unsigned char)text[i] << 8;
    for (int b = 0; b < 8; b++) crc = (crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1) & 0xFFFF;
  }
  return crc;
}

void send(const char *body) {
  char tail[8];
  snprintf(tail, sizeof tail, "*%04X\n", crc16(body, strlen(body)));
  Serial.print('<');
  Serial.print(body);
  Serial.print(tail);
}

void writeValves() {
  for (int i = 0; i < M; i++) {
    float share = state == 'R' || state == 'H' ? target[i] / FULL_SCALE_KPA : 0.0;
    analogWrite(OUT[i], (int)(255.0 * constrain(share, 0.0, 1.0) + 0.5));
  }
}

void vent(char next) {
  for (int i = 0; i < M; i++) target[i] = 0.0;
  state = next;
  writeValves();
}

void sendInfo() {
  char body[96], low[12], high[12];
  dtostrf(LOW_KPA, 1, 3, low);
  dtostrf(HIGH_KPA, 1, 3, high);
  snprintf(body, sizeof body, "INFO 1 %d %s %s %lu %lu sketch", M, low, high, holdMs, ventMs);
  send(body);
}

void refuse(unsigned long number, const char *why) {
  char body[48];
  snprintf(body, sizeof body, "NAK %lu %s", number, why);
  send(body);
}

void obey(char *body) {
  char *word = strtok(body, " ");
  if (!word) return;
  if (!strcmp(word, "HELLO")) { sendInfo(); return; }
  char *first = strtok(NULL, " ");
  if (!first) { refuse(0, "malformed"); return; }
  unsigned long number = strtoul(first, NULL, 10);
  if (!strcmp(word, "WATCH")) {
    char *second = strtok(NULL, " ");
    unsigned long longest = second ? strtoul(second, NULL, 10) : 0;
    if (number > 0 && number <= longest && longest <= LONGEST_MS) { holdMs = number; ventMs = longest; }
    sendInfo();
  } else if (!strcmp(word, "VENT")) {
    seq = number;
    vent(state == 'T' ? 'T' : 'I');
  } else if (!strcmp(word, "ARM")) {
    seq = number;
    vent('I');
  } else if (!strcmp(word, "SET")) {
    if (state == 'T') { refuse(number, "tripped"); return; }
    float wanted[M];
    for (int i = 0; i < M; i++) {
      char *text = strtok(NULL, " ");
      if (!text) { refuse(number, "too few pressures"); return; }
      char *end;
      wanted[i] = strtod(text, &end);
      if (end == text || !(wanted[i] > -1e6 && wanted[i] < 1e6)) { refuse(number, "malformed"); return; }
    }
    for (int i = 0; i < M; i++) target[i] = constrain(wanted[i], LOW_KPA, HIGH_KPA);
    seq = number;
    lastSetMs = millis();
    state = 'R';
    writeValves();
  }
}

void takeIn(char c) {
  if (c != '\n') {
    if (length < (int)sizeof in - 1) in[length++] = c;
    return;
  }
  in[length] = 0;
  if (length > 6 && in[0] == '>' && in[length - 5] == '*') {
    unsigned int said = strtoul(in + length - 4, NULL, 16);
    if (crc16(in + 1, length - 6) == said) {
      in[length - 5] = 0;
      obey(in + 1);
    }
  }
  length = 0;
}

void report() {
  char body[200];
  int n = snprintf(body, sizeof body, "DATA %lu %lu %c", millis(), seq, state);
  for (int i = 0; i < M; i++) {
    char text[12];
    dtostrf(analogRead(IN[i]) * SENSOR_KPA_PER_COUNT - SENSOR_ZERO_KPA, 1, 3, text);
    n += snprintf(body + n, sizeof body - n, " %s", text);
  }
  for (int i = 0; i < M; i++) {
    char text[12];
    dtostrf(target[i], 1, 3, text);
    n += snprintf(body + n, sizeof body - n, " %s", text);
  }
  send(body);
}

void setup() {
  for (int i = 0; i < M; i++) pinMode(OUT[i], OUTPUT);
  vent('I');
  Serial.begin(115200);
}

void loop() {
  while (Serial.available()) takeIn(Serial.read());
  unsigned long now = millis();
  if (state == 'R' && now - lastSetMs > holdMs) state = 'H';
  if ((state == 'R' || state == 'H') && now - lastSetMs > ventMs) vent('T');
  if (now - lastReportMs >= REPORT_MS) { lastReportMs = now; report(); }
}
