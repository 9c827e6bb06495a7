/* Plays the Force Dimension library for the tests. */
#include <stdbool.h>
#include <string.h>

static struct {
    double position[3], velocity[3], rotation[3][3], wrench[6];
    int open, enabled, reset, error, major, buttons, gone, robotic, driving, drives, stuck;
} s = {.rotation = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, .reset = 1, .major = 3};

static int result(char id) {
    if (s.gone || !s.open || id != 2) { s.error = 1009; return -1; }
    return 0;
}
void dhdGetSDKVersion(int *a, int *b, int *c, int *d) { *a = s.major; *b = 17; *c = 6; *d = 0; }
int dhdGetDeviceCount(void) { return s.gone ? 0 : 1; }
int dhdOpenID(char index) {
    if (index != 0 || s.gone) { s.error = 1003; return -1; }
    s.open = 1;
    return 2;
}
int dhdClose(char id) { s.open = 0; s.enabled = 0; return id == 2 ? 0 : -1; }
const char *dhdGetSystemName(char id) { (void)id; return "omega.6"; }
int dhdGetSerialNumber(unsigned short *sn, char id) { *sn = 1234; return result(id); }
int dhdGetStatus(int status[17], char id) { memset(status, 0, 17 * sizeof(int)); status[3] = s.reset; return result(id); }
int dhdEnableForce(unsigned char on, char id) { s.enabled = on; return result(id); }
int dhdGetPositionAndOrientationFrame(double *x, double *y, double *z, double m[3][3], char id) {
    *x = s.position[0]; *y = s.position[1]; *z = s.position[2];
    memcpy(m, s.rotation, sizeof s.rotation);
    return result(id) < 0 ? -1 : 1; /* the time guard's one is no error */
}
int dhdGetLinearVelocity(double *x, double *y, double *z, char id) {
    *x = s.velocity[0]; *y = s.velocity[1]; *z = s.velocity[2];
    return result(id);
}
unsigned int dhdGetButtonMask(char id) { (void)id; return (unsigned int)s.buttons; }
int dhdSetForceAndTorque(double fx, double fy, double fz, double tx, double ty, double tz, char id) {
    double w[6] = {fx, fy, fz, tx, ty, tz};
    if (result(id) < 0) return -1;
    if (s.driving) { s.error = 1012; return -1; } /* the robotic loop has the motors */
    memcpy(s.wrench, w, sizeof w);
    return 0;
}
bool dhdHasActiveWrist(char id) { (void)id; return false; }
int dhdErrorGetLast(void) { return s.error; }
const char *dhdErrorGetLastStr(void) { return "fake error"; }

#ifdef WITH_DRD
/* The robotic library: the same functions, and those that drive the device by itself. */
int drdOpenID(char index) { int id = dhdOpenID(index); s.robotic = id >= 0; return id; }
int drdClose(char id) { s.robotic = 0; s.driving = 0; return dhdClose(id); }
bool drdIsSupported(char id) { return id == 2 && s.robotic; }
bool drdIsInitialized(char id) { (void)id; return s.reset; }
int drdAutoInit(char id) {
    if (result(id) < 0 || !s.robotic) return -1;
    s.driving = 1;
    s.drives++;
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
void fake_place(double x, double y, double z, double vx) {
    s.position[0] = x; s.position[1] = y; s.position[2] = z; s.velocity[0] = vx;
}
void fake_turn_up(void) { /* a quarter turn about the maker's z */
    static const double m[3][3] = {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}};
    memcpy(s.rotation, m, sizeof m);
}
void fake_reset(int r) { s.reset = r; }
void fake_major(int m) { s.major = m; }
void fake_gone(int g) { s.gone = g; if (g) s.open = 0; }
void fake_force(double *out) { memcpy(out, s.wrench, sizeof s.wrench); }
int fake_open(void) { return s.open; }
