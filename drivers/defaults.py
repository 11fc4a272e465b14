"""Properties of the devices that a configuration may change. Configuration and drivers take them from here."""

# The EIT-kit: the mean over two recordings of 832 frames each.
FRAME_PERIOD_S = 0.5408
# The load cell, measured on the paper's rig (4882 lines in 447 s); the HX711's data sheet says 10 samples a second.
LOAD_CELL_RATE_HZ = 10.9
# A UR controller's services: RTDE, the Real-Time Client, which takes programs, and the Dashboard Server.
RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
# Its Primary Client Interface, which reports error codes.
PRIMARY_PORT = 30001
# The serial number of an emulated controller: ur-rtde accepts only digits, and no real number has so many.
EMULATED_ANSWER = "0" * 16
# The serial number that this stands for, in sentences and reports.
EMULATED_SERIAL_NUMBER = "EMULATED"
# The gripper behind the URCap.
URCAP_PORT = 63352
# The shear skin's current source. Twice two gauges of 25 Ω and their leads need 1 V; harmless for people and gauges.
SOURCE_CURRENT_MA, SOURCE_COMPLIANCE_V = 5.0, 1.0
SOURCE_BAUD = 9600
# The shear skin's voltages: a scanner's range above 5 mA × 25 Ω, and an ADS1220's at gain 4 with its own reference.
DAQ_RATE_HZ = 10.0
SCANNER_CHANNELS, SCANNER_RANGE_V = (101, 102), 1.0
ADC_FULL_SCALE_V = 0.512
# The 95 % bound of the paper's drift, 1.48e-4 over an hour (Yin et al. 2017).
DRIFT_PER_HOUR = 2.9e-4
