/* Plays libHD.so for the tests, strictly: what HDAPI's documentation does not allow is an error here. */
#include <string.h>

typedef unsigned int HHD;
typedef struct { unsigned int errorCode; int internalErrorCode; HHD hHD; } HDErrorInfo;
typedef unsigned int (*HDSchedulerCallback)(void *);

static struct {
    double position[3], velocity[3], transform[16], force[3], pending[3];
    int buttons, open, current, running, in_frame, force_on, calibration, styles;
    unsigned int error, each_frame;
    unsigned long rate;
    long frames, forces;
    const char *version;
} s = {.transform = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, .calibration = 0x5000, .styles = 4, .version = "3.4.0"};

static void fail(unsigned int code) { if (!s.error) s.error = code; }

HHD hdInitDevice(const char *name) {
    if (name && strcmp(name, "Left Device")) { fail(0x300); return 0xFFFFFFFFu; }
    if (s.open) { fail(0x301); return 0xFFFFFFFFu; }
    s.open = 1;
    return 7;
}
void hdDisableDevice(HHD h) { if (h != 7 || !s.open) fail(0x104); s.open = 0; }
void hdMakeCurrentDevice(HHD h) { if (h != 7) fail(0x104); s.current = 1; }
void hdBeginFrame(HHD h) {
    if (h != 7 || !s.open) { fail(0x104); return; }
    if (s.in_frame || !s.running) fail(0x400);
    s.in_frame = s.current = 1;
}
void hdEndFrame(HHD h) {
    if (!s.in_frame) fail(0x401);
    s.in_frame = 0;
    s.frames++;
    if (s.force_on) memcpy(s.force, s.pending, sizeof s.force);
    if (s.each_frame) fail(s.each_frame);
}
void hdEnable(unsigned int what) { if (what == 0x4000 && s.current) s.force_on = 1; else fail(0x100); }
void hdGetDoublev(unsigned int what, double *out) {
    static const double box[6] = {-80, -60, -35, 80, 60, 35};
    switch (what) {
    case 0x2050: case 0x2051: case 0x2052:
        if (!s.in_frame) { fail(0x102); return; }
        if (what == 0x2050) memcpy(out, s.position, sizeof s.position);
        else if (what == 0x2051) memcpy(out, s.velocity, sizeof s.velocity);
        else memcpy(out, s.transform, sizeof s.transform);
        break;
    case 0x2551: memcpy(out, box, sizeof box); break;
    case 0x2602: *out = 0.7; break;
    case 0x2603: *out = 3.3; break;
    case 0x2604: *out = 0.88; break;
    case 0x2609: *out = 0.005; break;
    default: fail(0x100);
    }
}
void hdSetDoublev(unsigned int what, const double *in) {
    if (what != 0x2700 || !s.in_frame) { fail(0x102); return; }
    memcpy(s.pending, in, sizeof s.pending);
    s.forces++;
}
void hdGetIntegerv(unsigned int what, int *out) {
    if (what == 0x2000) *out = s.buttons;
    else if (what == 0x2555 && s.current) *out = s.styles;
    else fail(0x100);
}
const char *hdGetString(unsigned int what) {
    switch (what) {
    case 0x2500: return s.version;
    case 0x2501: return "Fake Omni";
    case 0x2504: return "0042";
    default: fail(0x100); return "";
    }
}
HDErrorInfo hdGetError(void) {
    HDErrorInfo e = {s.error, (int)s.error, 7};
    s.error = 0;
    return e;
}
/* Of the current device; the other one is well. */
unsigned int hdCheckCalibration(void) { return s.current ? (unsigned int)s.calibration : 0x5000; }
void hdUpdateCalibration(unsigned int style) {
    if (!s.current || !(style & (unsigned int)s.styles)) { fail(0x101); return; }
    if (s.calibration == 0x5001) s.calibration = 0x5000;
}
void hdStartScheduler(void) { if (s.running) fail(0x102); s.running = 1; }
void hdStopScheduler(void) { if (!s.running) fail(0x102); s.running = 0; }
void hdSetSchedulerRate(unsigned long rate) { s.rate = rate; if (rate != 500 && rate != 1000) fail(0x101); }
#ifndef WITHOUT_SCHEDULER
void hdScheduleSynchronous(HDSchedulerCallback call, void *data, unsigned short priority) {
    (void)priority;
    if (!s.running) { fail(0x102); return; }
    call(data);
}
#endif

/* The test's own ends. */
void fake_place(double x, double y, double z, double vx) {
    s.position[0] = x; s.position[1] = y; s.position[2] = z; s.velocity[0] = vx;
}
void fake_quarter_turn(void) { /* about x: y to z; column-major */
    static const double t[16] = {1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1};
    memcpy(s.transform, t, sizeof t);
}
void fake_another_is_current(void) { s.current = 0; }
void fake_buttons(int b) { s.buttons = b; }
void fake_error(unsigned int code) { s.each_frame = code; }
void fake_calibration(int c) { s.calibration = c; }
void fake_version(const char *v) { s.version = v; }
void fake_force(double *out) { memcpy(out, s.force, sizeof s.force); }
int fake_running(void) { return s.running; }
int fake_open(void) { return s.open; }
long fake_frames(void) { return s.frames; }
unsigned long fake_error_size(void) { return sizeof(HDErrorInfo); }
unsigned long fake_long_size(void) { return sizeof(unsigned long); }
