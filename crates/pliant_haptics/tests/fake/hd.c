/* Plays libHD.so for the tests, strictly: what HDAPI's documentation does not allow is an error here.
   Also plays the hardware behind it, whose watchdog switches the force off when no frame has come
   for a while: the maker's ErrorHandling example says that "it needs frequent updates to stay alive". */
#define _GNU_SOURCE
#include <fcntl.h>
#include <math.h>
#include <stddef.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

typedef unsigned int HHD;
typedef unsigned char HDboolean;
typedef struct { unsigned int errorCode; int internalErrorCode; HHD hHD; } HDErrorInfo;
typedef unsigned int (*HDSchedulerCallback)(void *);

struct state {
    double position[3], velocity[3], transform[16], force[3], pending[3], frame_at, patience;
    int made, buttons, open, current, running, in_frame, force_on, calibration, styles, switch_, has_switch;
    unsigned int errors[64], each_frame, first_error;
    int depth, error_count, servo, hung, disabled, stops, init_hangs, stop_hangs, in_init, in_stop;
    unsigned long rate;
    long frames, forces;
    double felt, rise;
};
static struct state own;
static volatile struct state *state = &own;
#define s (*state)
static const char *version = "3.4.0";
static struct { HDSchedulerCallback call; void *data; } waiting[64];
static volatile int waits;

enum { ALIVE, DEAD, STUCK, LOST_CALL, LOCKED, LATE };

/* With STATE, two processes that load this library see one device. */
__attribute__((constructor)) static void make(void) {
#ifdef STATE
    int file = open(STATE, O_RDWR | O_CREAT, 0600);
    if (file < 0 || ftruncate(file, sizeof own)) return;
    void *at = mmap(NULL, sizeof own, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    close(file);
    if (at == MAP_FAILED) return;
    state = at;
#endif
    if (s.made) return;
    s.made = 1;
    for (int i = 0; i < 4; i++) s.transform[5 * i] = 1;
    s.calibration = 0x5000;
    s.styles = 4;
    s.error_count = 1;
}
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
/* Hangs while `on`, and says so in `in`. */
static void hang(volatile int *on, volatile int *in) {
    while (*on) { *in = 1; usleep(100); }
    *in = 0;
}
static void keep(HDSchedulerCallback call, void *data) {
    if (waits >= 64) return;
    waiting[waits].call = call;
    waiting[waits++].data = data;
}
/* Errors are a stack: the newest comes out first. */
static void fail(unsigned int code) { if (s.depth < 64) s.errors[s.depth++] = code; }

/* What the motors exert now. */
static int exerts(void) {
    int alive = s.patience <= 0 || now() - s.frame_at <= s.patience;
    int held = !s.has_switch || s.switch_;
    return s.force_on && s.running && s.open && alive && held;
}
/* Keeps the largest rise of it from one call to the next. */
static void feel(void) {
    double f = exerts() ? sqrt(s.force[0] * s.force[0] + s.force[1] * s.force[1] + s.force[2] * s.force[2]) : 0;
    if (f - s.felt > s.rise) s.rise = f - s.felt;
    s.felt = f;
}

HHD hdInitDevice(const char *name) {
    hang(&s.init_hangs, &s.in_init);
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
    (void)h;
    if (!s.in_frame) fail(0x401);
    s.in_frame = 0;
    s.frames++;
    feel();
    s.frame_at = now();
    if (s.force_on) memcpy((void *)s.force, (const void *)s.pending, sizeof s.force);
    feel();
    if (s.first_error) fail(s.first_error);
    for (int i = 0; s.each_frame && i < s.error_count; i++) fail(s.each_frame);
}
void hdEnable(unsigned int what) { if (what == 0x4000 && s.current) s.force_on = 1; else fail(0x100); }
void hdDisable(unsigned int what) {
    if (what == 0x4000 && s.current) { s.force_on = 0; s.disabled++; } else fail(0x100);
}
HDboolean hdIsEnabled(unsigned int what) {
    if (what == 0x4000 && s.current) return s.force_on != 0;
    fail(0x100);
    return 0;
}
void hdGetBooleanv(unsigned int what, HDboolean *out) {
    if (what != 0x2001 || !s.has_switch) { fail(0x100); return; }
    if (!s.in_frame) { fail(0x102); return; }
    *out = s.switch_ != 0;
}
void hdGetDoublev(unsigned int what, double *out) {
    static const double box[6] = {-80, -60, -35, 80, 60, 35};
    switch (what) {
    case 0x2050: case 0x2051: case 0x2052:
        if (!s.in_frame) { fail(0x102); return; }
        if (what == 0x2050) memcpy(out, (const void *)s.position, sizeof s.position);
        else if (what == 0x2051) memcpy(out, (const void *)s.velocity, sizeof s.velocity);
        else memcpy(out, (const void *)s.transform, sizeof s.transform);
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
    memcpy((void *)s.pending, in, sizeof s.pending);
    s.forces++;
}
void hdGetIntegerv(unsigned int what, int *out) {
    if (what == 0x2000) *out = s.buttons;
    else if (what == 0x2555 && s.current) *out = s.styles;
    else fail(0x100);
}
const char *hdGetString(unsigned int what) {
    switch (what) {
    case 0x2500: return version;
    case 0x2501: return "Fake Omni";
    case 0x2504: return "0042";
    default: fail(0x100); return "";
    }
}
HDErrorInfo hdGetError(void) {
    unsigned int code = s.depth > 0 ? s.errors[--s.depth] : 0;
    HDErrorInfo e = {code, (int)code, 7};
    return e;
}
/* Of the current device; the other one is well. */
unsigned int hdCheckCalibration(void) { return s.current ? (unsigned int)s.calibration : 0x5000; }
void hdUpdateCalibration(unsigned int style) {
    if (!s.current || !(style & (unsigned int)s.styles)) { fail(0x101); return; }
    if (s.calibration == 0x5001) s.calibration = 0x5000;
}
void hdStartScheduler(void) { if (s.running) fail(0x102); s.running = 1; }
void hdStopScheduler(void) {
    hang(&s.stop_hangs, &s.in_stop);
    if (!s.running) fail(0x102);
    s.running = 0;
    s.stops++;
    memset((void *)s.force, 0, sizeof s.force); /* no servo, no force */
}
void hdSetSchedulerRate(unsigned long rate) { s.rate = rate; if (rate != 500 && rate != 1000) fail(0x101); }
#ifndef WITHOUT_SCHEDULER
void hdScheduleSynchronous(HDSchedulerCallback call, void *data, unsigned short priority) {
    (void)priority;
    if (!s.running) { fail(0x102); return; }
    if (s.servo == DEAD) return; /* it never runs, and nobody says so */
    if (s.servo == LATE) { keep(call, data); return; } /* it runs late, and nobody says so */
    while (s.servo == STUCK || s.servo == LOST_CALL || s.servo == LOCKED) { s.hung = 1; usleep(100); }
    s.hung = 0;
    call(data);
}
#endif
/* The servo thread: with STUCK it runs nothing until it is alive again. */
unsigned long hdScheduleAsynchronous(HDSchedulerCallback call, void *data, unsigned short priority) {
    (void)priority;
    if (!s.running) { fail(0x102); return 0; }
    while (s.servo == LOCKED) usleep(100); /* a lock of the library that the stuck call holds */
    if (s.servo == ALIVE || s.servo == LOST_CALL) {
        s.in_frame = 0;
        call(data);
    } else {
        keep(call, data);
    }
    return 1;
}

/* The test's own ends. */
void fake_place(double x, double y, double z, double vx) {
    s.position[0] = x; s.position[1] = y; s.position[2] = z; s.velocity[0] = vx;
}
void fake_quarter_turn(void) { /* about x: y to z; column-major */
    static const double t[16] = {1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1};
    memcpy((void *)s.transform, t, sizeof t);
}
void fake_another_is_current(void) { s.current = 0; }
void fake_buttons(int b) { s.buttons = b; }
void fake_error(unsigned int code) { s.each_frame = code; }
/* Before those of each frame. */
void fake_first_error(unsigned int code) { s.first_error = code; }
void fake_error_count(int n) { s.error_count = n; }
int fake_errors_left(void) { return s.depth; }
void fake_calibration(int c) { s.calibration = c; }
void fake_version(const char *v) { version = v; }
/* 1: a hand holds the stylus, 0: none does, -1: the device has no such switch. */
void fake_safety_switch(int on) { s.has_switch = on >= 0; s.switch_ = on > 0; feel(); }
/* The largest rise of the force since the last look, N. */
double fake_rise(void) { double r = s.rise; s.rise = 0; return r; }
/* Runs what waits since the servo was dead, stuck or late. */
void fake_run_waiting(void) {
    while (waits > 0) {
        waits--;
        s.in_frame = 0;
        waiting[waits].call(waiting[waits].data);
    }
}
/* 0: alive, 1: dead, 2: stuck with all that it should run, 3: stuck in the caller's call only,
   4: stuck in every call that schedules something, 5: runs what it is given late. */
void fake_servo(int mode) {
    s.servo = mode;
    if (mode == ALIVE) fake_run_waiting();
}
/* The servo lives again, and has not run yet what waits. */
void fake_revive(void) { s.servo = ALIVE; }
void fake_init_hangs(int on) { s.init_hangs = on; }
int fake_in_init(void) { return s.in_init; }
void fake_stop_hangs(int on) { s.stop_hangs = on; }
int fake_in_stop(void) { return s.in_stop; }
int fake_hung(void) { return s.hung; }
/* Time after which the hardware switches the force off, s; 0: never. */
void fake_hardware_watchdog(double seconds) { s.patience = seconds; }
void fake_force(double *out) { memcpy(out, (const void *)s.force, sizeof s.force); }
/* The force that the motors exert now. */
void fake_motor(double *out) {
    memset(out, 0, sizeof s.force);
    if (exerts()) memcpy(out, (const void *)s.force, sizeof s.force);
}
int fake_disabled(void) { return s.disabled; }
int fake_running(void) { return s.running; }
int fake_open(void) { return s.open; }
long fake_frames(void) { return s.frames; }
unsigned long fake_error_size(void) { return sizeof(HDErrorInfo); }
unsigned long fake_error_offsets(void) {
    return offsetof(HDErrorInfo, errorCode) | offsetof(HDErrorInfo, internalErrorCode) << 8 |
           offsetof(HDErrorInfo, hHD) << 16;
}
unsigned long fake_long_size(void) { return sizeof(unsigned long); }
unsigned long fake_boolean_size(void) { return sizeof(HDboolean); }
