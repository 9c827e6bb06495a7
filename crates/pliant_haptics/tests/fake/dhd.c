/* Plays the Force Dimension library for the tests, and the firmware behind it. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <math.h>
#include <stdbool.h>
#include <string.h>
#include <sys/mman.h>
#include <time.h>
#include <unistd.h>

struct state {
    double position[3], velocity[3], rotation[3][3], wrench[6], sent_at;
    int made, open, enabled, reset, error, major, buttons, gone, robotic, driving, drives, stuck;
    int watchdog, expert, cause, user_off, hang, hung, slow, opening, off_hangs, in_off;
    double felt, rise, open_time, start_time;
};
static struct state own;
static volatile struct state *state = &own;
#define s (*state)

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
    s.made = s.reset = 1;
    s.major = 3;
    for (int i = 0; i < 3; i++) s.rotation[i][i] = 1;
}
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* The firmware: it switches the force off when no command has come for the watchdog's time. The
   library's documentation says so: "the device firmware will disable forces". */
static void firmware(void) {
    if (s.enabled && s.watchdog && now() - s.sent_at > 125e-6 * s.watchdog) {
        s.enabled = 0;
        s.cause = 3;
    }
}
/* Keeps the largest rise of what the motors exert from one call to the next. */
static void feel(void) {
    double f = 0;
    firmware();
    if (s.enabled && !s.user_off && s.open) f = sqrt(s.wrench[0] * s.wrench[0] + s.wrench[1] * s.wrench[1] + s.wrench[2] * s.wrench[2]);
    if (f - s.felt > s.rise) s.rise = f - s.felt;
    s.felt = f;
}
static int result(char id) {
    feel();
    if (s.gone || !s.open || id != 2) { s.error = 1009; return -1; }
    return 0;
}
/* Takes its time within a call that opens the device or makes it ready to drive. */
static void take(double seconds) {
    s.opening = seconds > 0;
    for (double end = now() + seconds; now() < end;) usleep(100);
    s.opening = 0;
}
void dhdGetSDKVersion(int *a, int *b, int *c, int *d) { *a = s.major; *b = 17; *c = 6; *d = 0; }
int dhdGetDeviceCount(void) { return s.gone ? 0 : 1; }
int dhdOpenID(char index) {
    if (index != 0 || s.gone) { s.error = 1003; return -1; }
    take(s.open_time);
    s.open = 1;
    return 2;
}
int dhdClose(char id) { s.open = 0; s.enabled = 0; return id == 2 ? 0 : -1; }
const char *dhdGetSystemName(char id) { (void)id; return "omega.6"; }
int dhdGetSerialNumber(unsigned short *sn, char id) { *sn = 1234; return result(id); }
int dhdGetStatus(int status[16], char id) {
    int r = result(id);
    memset(status, 0, 16 * sizeof(int));
    status[0] = status[1] = status[2] = 1;
    status[3] = s.reset;
    status[5] = s.enabled && !s.user_off;
    status[14] = s.user_off ? 1 : s.enabled ? 0 : s.cause;
    return r;
}
int dhdEnableForce(unsigned char on, char id) {
    while (!on && s.off_hangs) { s.in_off = 1; usleep(100); }
    int r = result(id);
    if (r < 0) return r;
    if (on && !s.enabled) s.sent_at = now();
    s.enabled = on;
    s.cause = on ? 0 : 4;
    feel();
    return r;
}
int dhdGetPositionAndOrientationFrame(double *x, double *y, double *z, double m[3][3], char id) {
    *x = s.position[0]; *y = s.position[1]; *z = s.position[2];
    memcpy(m, (const void *)s.rotation, sizeof s.rotation);
    return result(id) < 0 ? -1 : 1; /* the time guard's one is no error */
}
int dhdGetLinearVelocity(double *x, double *y, double *z, char id) {
    *x = s.velocity[0]; *y = s.velocity[1]; *z = s.velocity[2];
    return result(id);
}
unsigned int dhdGetButtonMask(char id) { (void)id; return (unsigned int)s.buttons; }
int dhdSetForceAndTorque(double fx, double fy, double fz, double tx, double ty, double tz, char id) {
    double w[6] = {fx, fy, fz, tx, ty, tz};
    while (s.hang) { s.hung = 1; usleep(100); } /* the cable, the kernel's driver or a lock */
    s.hung = 0;
    if (result(id) < 0) return -1;
    if (s.driving) { s.error = 1012; return -1; } /* the robotic loop has the motors */
    memcpy((void *)s.wrench, w, sizeof w);
    s.sent_at = now();
    feel();
    return 0;
}
bool dhdHasActiveWrist(char id) { (void)id; return false; }
int dhdErrorGetLast(void) { return s.error; }
const char *dhdErrorGetLastStr(void) { return "fake error"; }
#ifndef WITHOUT_WATCHDOG
int dhdEnableExpertMode(void) { s.expert = 1; return 0; }
int dhdDisableExpertMode(void) { s.expert = 0; return 0; }
int dhdSetWatchdog(unsigned char units, char id) {
    if (!s.expert) { s.error = 9; return -1; } /* DHD_ERROR_EXPERT_MODE_DISABLED */
    s.watchdog = units;
    return result(id);
}
#endif

#ifdef WITH_DRD
/* The robotic library: the same functions, and those that drive the device by itself. */
int drdOpenID(char index) { int id = dhdOpenID(index); s.robotic = id >= 0; return id; }
int drdClose(char id) { s.robotic = 0; s.driving = 0; return dhdClose(id); }
bool drdIsSupported(char id) { return id == 2 && s.robotic; }
bool drdIsInitialized(char id) { (void)id; return s.reset; }
int drdAutoInit(char id) {
    if (result(id) < 0 || !s.robotic) return -1;
    take(s.start_time); /* drdStop finds nothing to stop yet */
    s.driving = 1;
    s.drives++;
    while (s.slow && s.driving) usleep(100); /* it drives until somebody ends it */
    if (!s.driving) return -1;
    if (s.stuck) { s.error = 1008; return -1; }
    s.reset = 1;
    return 0;
}
int drdStop(bool force, char id) { s.driving = 0; if (!force) s.enabled = 0; return result(id); }
#endif
void fake_stuck(int x) { s.stuck = x; }
int fake_drives(void) { return s.drives; }
int fake_driving(void) { return s.driving; }
int fake_enabled(void) { return s.enabled; }
int fake_watchdog_us(void) { return 125 * s.watchdog; }
void fake_place(double x, double y, double z, double vx) {
    s.position[0] = x; s.position[1] = y; s.position[2] = z; s.velocity[0] = vx;
}
void fake_turn_up(void) { /* a quarter turn about the maker's z */
    static const double m[3][3] = {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}};
    memcpy((void *)s.rotation, m, sizeof m);
}
void fake_reset(int r) { s.reset = r; }
void fake_major(int m) { s.major = m; }
void fake_gone(int g) { s.gone = g; if (g) s.open = 0; }
void fake_slow_drive(int on) { s.slow = on; }
/* Times that the next calls take to open the device and to begin a drive, s. */
void fake_slow_open(double open, double start) { s.open_time = open; s.start_time = start; }
int fake_opening(void) { return s.opening; }
void fake_hang(int on) { s.hang = on; }
int fake_hung(void) { return s.hung; }
/* The call that switches the force off hangs. */
void fake_off_hangs(int on) { s.off_hangs = on; }
int fake_in_off(void) { return s.in_off; }
/* The button on the device that switches its force off. */
void fake_user_off(int off) { s.user_off = off; feel(); }
/* The force that was sent last. */
void fake_force(double *out) { memcpy(out, (const void *)s.wrench, sizeof s.wrench); }
/* The force that the motors exert now. */
void fake_motor(double *out) {
    firmware();
    memset(out, 0, sizeof s.wrench);
    if (s.enabled && !s.user_off) memcpy(out, (const void *)s.wrench, sizeof s.wrench);
}
/* The largest rise of the force since the last look, N. */
double fake_rise(void) { double r = s.rise; s.rise = 0; return r; }
int fake_open(void) { return s.open; }
