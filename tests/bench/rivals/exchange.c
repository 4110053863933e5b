/* The exchange of a lock-step flight in C: what the same datagrams cost at least.
 *
 *   exchange ground LOCAL REMOTE            answers until it is ended
 *   exchange vehicle LOCAL REMOTE SECONDS   prints: times real time, metres off its place, bytes out and in per tick
 *
 * Two processes on connected, blocking UDP sockets. Every 4 ms of simulated time the vehicle sends ODOMETRY, with the
 * slow messages at the rates of mavsitl's off-board link in the same datagram, waits for SET_ATTITUDE_TARGET with this
 * tick's stamp, and takes four RK4 steps of 1 ms: position, velocity, quaternion, body rates and four rotor speeds, 17
 * states. The ground flies the vehicle to (0, 0, -1) by a position PID and an attitude P. Frames are MAVLink 2, field by
 * field, with the checksum over every byte, both ways. No wind, no noise, no log, no learning, no other message.
 *
 * World NED, body FRD, SI units. The CRC_* are the messages' CRC_EXTRA, given by whoever compiles this.
 */

#include <arpa/inet.h>
#include <errno.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { HEARTBEAT = 0, SYS_STATUS = 1, ATTITUDE = 30, ATTITUDE_QUATERNION = 31, LOCAL_POSITION_NED = 32,
       SET_ATTITUDE_TARGET = 82, EXTENDED_SYS_STATE = 245, ODOMETRY = 331 };
enum { HEADER = 10, CHECKSUM = 2, LARGEST = HEADER + 255 + CHECKSUM, DATAGRAM = 2048 };
enum { TICK_US = 4000, SUBSTEPS = 4, SLOW = 25, SLOWER = 50, SLOWEST = 250 };

static const double MASS = 0.723, GRAVITY = 9.81, ARM = 0.31, THRUST = 5.324e-5, DRAG = 8.721e-7, ROTOR_S = 0.01;
static const double INERTIA[3] = {8.678e-3, 8.678e-3, 3.217e-2};
static const double RATE_GAIN[3] = {40.0, 40.0, 10.0}; /* 1/s */
#define MAX_THRUST (2.0 * MASS * GRAVITY)

/* MAVLink 2 */

typedef struct { uint8_t bytes[LARGEST]; int length; } Payload;
typedef struct { uint8_t bytes[DATAGRAM]; int length; uint8_t sequence, system, component; } Writer;

static int crc_extra(uint32_t id) {
    switch (id) {
    case HEARTBEAT: return CRC_HEARTBEAT;
    case SYS_STATUS: return CRC_SYS_STATUS;
    case ATTITUDE: return CRC_ATTITUDE;
    case ATTITUDE_QUATERNION: return CRC_ATTITUDE_QUATERNION;
    case LOCAL_POSITION_NED: return CRC_LOCAL_POSITION_NED;
    case SET_ATTITUDE_TARGET: return CRC_SET_ATTITUDE_TARGET;
    case EXTENDED_SYS_STATE: return CRC_EXTENDED_SYS_STATE;
    case ODOMETRY: return CRC_ODOMETRY;
    default: return -1;
    }
}

/* CRC-16/MCRF4XX, a byte at a time. */
static uint16_t crc_byte(uint16_t crc, uint8_t byte) {
    uint8_t folded = byte ^ (uint8_t)crc;
    folded ^= (uint8_t)(folded << 4);
    return (uint16_t)((crc >> 8) ^ (folded << 8) ^ (folded << 3) ^ (folded >> 4));
}

static uint16_t crc_of(const uint8_t *bytes, int length, uint8_t extra) {
    uint16_t crc = 0xFFFF;
    for (int i = 0; i < length; i++) crc = crc_byte(crc, bytes[i]);
    return crc_byte(crc, extra);
}

static void put(Payload *payload, const void *value, int size) {
    memcpy(payload->bytes + payload->length, value, (size_t)size); /* of a little-endian machine */
    payload->length += size;
}
static void put_u8(Payload *p, uint8_t v) { put(p, &v, 1); }
static void put_u16(Payload *p, uint16_t v) { put(p, &v, 2); }
static void put_u32(Payload *p, uint32_t v) { put(p, &v, 4); }
static void put_u64(Payload *p, uint64_t v) { put(p, &v, 8); }
static void put_f(Payload *p, double v) { float f = (float)v; put(p, &f, 4); }

static void frame(Writer *w, uint32_t id, const Payload *payload) {
    int length = payload->length;
    while (length > 1 && !payload->bytes[length - 1]) length--;
    uint8_t *at = w->bytes + w->length;
    uint8_t header[HEADER] = {0xFD, (uint8_t)length, 0, 0, w->sequence++, w->system, w->component,
                              (uint8_t)id, (uint8_t)(id >> 8), (uint8_t)(id >> 16)};
    memcpy(at, header, HEADER);
    memcpy(at + HEADER, payload->bytes, (size_t)length);
    uint16_t crc = crc_of(at + 1, HEADER - 1 + length, (uint8_t)crc_extra(id));
    at[HEADER + length] = (uint8_t)crc;
    at[HEADER + length + 1] = (uint8_t)(crc >> 8);
    w->length += HEADER + length + CHECKSUM;
}

/* The next good frame of a datagram at *offset: its id, its payload filled up with zeros; -1 at the end. */
static int32_t next(const uint8_t *bytes, int length, int *offset, Payload *payload) {
    const uint8_t *at = bytes + *offset;
    if (length - *offset < HEADER + CHECKSUM || at[0] != 0xFD) return -1;
    int size = at[1];
    if (length - *offset < HEADER + size + CHECKSUM) return -1;
    uint32_t id = at[7] | (uint32_t)at[8] << 8 | (uint32_t)at[9] << 16;
    int extra = crc_extra(id);
    if (extra < 0) return -1;
    uint16_t crc = crc_of(at + 1, HEADER - 1 + size, (uint8_t)extra);
    if (at[HEADER + size] != (uint8_t)crc || at[HEADER + size + 1] != (uint8_t)(crc >> 8)) return -1;
    memcpy(payload->bytes, at + HEADER, (size_t)size);
    memset(payload->bytes + size, 0, (size_t)(LARGEST - size));
    payload->length = 0; /* from here on where the next field begins */
    *offset += HEADER + size + CHECKSUM;
    return (int32_t)id;
}

static void get(Payload *p, void *value, int size) { memcpy(value, p->bytes + p->length, (size_t)size); p->length += size; }
static uint8_t get_u8(Payload *p) { uint8_t v; get(p, &v, 1); return v; }
static uint32_t get_u32(Payload *p) { uint32_t v; get(p, &v, 4); return v; }
static uint64_t get_u64(Payload *p) { uint64_t v; get(p, &v, 8); return v; }
static double get_f(Payload *p) { float v; get(p, &v, 4); return v; }

/* Messages, as structures that are filled field by field. */

typedef struct {
    uint64_t stamp_us;
    double position[3], q[4], velocity[3], rates[3], pose_covariance[21], velocity_covariance[21];
    uint8_t frame_id, child_frame_id, reset_counter, estimator_type;
    int8_t quality;
} Odometry;

typedef struct {
    uint32_t stamp_ms;
    double q[4], rates[3], thrust;
    uint8_t system, component, mask;
} Target;

static void send_odometry(Writer *w, const Odometry *o) {
    Payload p = {.length = 0};
    put_u64(&p, o->stamp_us);
    for (int i = 0; i < 3; i++) put_f(&p, o->position[i]);
    for (int i = 0; i < 4; i++) put_f(&p, o->q[i]);
    for (int i = 0; i < 3; i++) put_f(&p, o->velocity[i]);
    for (int i = 0; i < 3; i++) put_f(&p, o->rates[i]);
    for (int i = 0; i < 21; i++) put_f(&p, o->pose_covariance[i]);
    for (int i = 0; i < 21; i++) put_f(&p, o->velocity_covariance[i]);
    put_u8(&p, o->frame_id); put_u8(&p, o->child_frame_id); put_u8(&p, o->reset_counter);
    put_u8(&p, o->estimator_type); put_u8(&p, (uint8_t)o->quality);
    frame(w, ODOMETRY, &p);
}

static void read_odometry(Payload *p, Odometry *o) {
    o->stamp_us = get_u64(p);
    for (int i = 0; i < 3; i++) o->position[i] = get_f(p);
    for (int i = 0; i < 4; i++) o->q[i] = get_f(p);
    for (int i = 0; i < 3; i++) o->velocity[i] = get_f(p);
    for (int i = 0; i < 3; i++) o->rates[i] = get_f(p);
    for (int i = 0; i < 21; i++) o->pose_covariance[i] = get_f(p);
    for (int i = 0; i < 21; i++) o->velocity_covariance[i] = get_f(p);
    o->frame_id = get_u8(p); o->child_frame_id = get_u8(p); o->reset_counter = get_u8(p);
    o->estimator_type = get_u8(p); o->quality = (int8_t)get_u8(p);
}

static void send_target(Writer *w, const Target *t) {
    Payload p = {.length = 0};
    put_u32(&p, t->stamp_ms);
    for (int i = 0; i < 4; i++) put_f(&p, t->q[i]);
    for (int i = 0; i < 3; i++) put_f(&p, t->rates[i]);
    put_f(&p, t->thrust);
    put_u8(&p, t->system); put_u8(&p, t->component); put_u8(&p, t->mask);
    for (int i = 0; i < 3; i++) put_f(&p, 0.0); /* thrust_body */
    frame(w, SET_ATTITUDE_TARGET, &p);
}

static void read_target(Payload *p, Target *t) {
    t->stamp_ms = get_u32(p);
    for (int i = 0; i < 4; i++) t->q[i] = get_f(p);
    for (int i = 0; i < 3; i++) t->rates[i] = get_f(p);
    t->thrust = get_f(p);
    t->system = get_u8(p); t->component = get_u8(p); t->mask = get_u8(p);
}

static void send_heartbeat(Writer *w, uint8_t type, uint8_t autopilot) {
    Payload p = {.length = 0};
    put_u32(&p, 0x00060000);
    put_u8(&p, type); put_u8(&p, autopilot); put_u8(&p, 0x81); put_u8(&p, 4); put_u8(&p, 3);
    frame(w, HEARTBEAT, &p);
}

/* The vehicle: p, v, q, omega, rotor speeds. */

typedef double State[17];

static void angles(const double *q, double *out) {
    out[0] = atan2(2.0 * (q[0] * q[1] + q[2] * q[3]), 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]));
    out[1] = asin(fmax(-1.0, fmin(1.0, 2.0 * (q[0] * q[2] - q[3] * q[1]))));
    out[2] = atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]));
}

static void derivative(const State x, const double *command, State out) {
    const double *q = x + 6, *w = x + 10, *speed = x + 13;
    double force[4], total = 0.0;
    for (int i = 0; i < 4; i++) { force[i] = THRUST * speed[i] * speed[i]; total += force[i]; }
    double lift = total / MASS;
    for (int i = 0; i < 3; i++) out[i] = x[3 + i];
    out[3] = -lift * 2.0 * (q[1] * q[3] + q[0] * q[2]);
    out[4] = -lift * 2.0 * (q[2] * q[3] - q[0] * q[1]);
    out[5] = GRAVITY - lift * (1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]));
    out[6] = -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]);
    out[7] = 0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]);
    out[8] = 0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]);
    out[9] = 0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]);
    double torque[3] = {ARM * (force[3] - force[1]), ARM * (force[2] - force[0]),
                        DRAG / THRUST * (force[1] + force[3] - force[0] - force[2])};
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        out[10 + i] = (torque[i] + (INERTIA[j] - INERTIA[k]) * w[j] * w[k]) / INERTIA[i];
    }
    for (int i = 0; i < 4; i++) out[13 + i] = (command[i] - speed[i]) / ROTOR_S;
}

static void rk4(State x, const double *command, double h) {
    State k[4], at;
    const double reach[3] = {0.5, 0.5, 1.0};
    derivative(x, command, k[0]);
    for (int stage = 0; stage < 3; stage++) {
        for (int i = 0; i < 17; i++) at[i] = x[i] + reach[stage] * h * k[stage][i];
        derivative(at, command, k[stage + 1]);
    }
    for (int i = 0; i < 17; i++) x[i] += h / 6.0 * (k[0][i] + 2.0 * (k[1][i] + k[2][i]) + k[3][i]);
    double norm = sqrt(x[6] * x[6] + x[7] * x[7] + x[8] * x[8] + x[9] * x[9]);
    for (int i = 6; i < 10; i++) x[i] /= norm;
}

/* Rate loop, and the rotor speeds for thrust and torques. */
static void allocate(const State x, const Target *t, double *command) {
    double u[3];
    for (int i = 0; i < 3; i++) u[i] = INERTIA[i] * RATE_GAIN[i] * (t->rates[i] - x[10 + i]);
    double all = t->thrust * MAX_THRUST / (4.0 * THRUST), roll = u[0] / (2.0 * ARM * THRUST);
    double pitch = u[1] / (2.0 * ARM * THRUST), yaw = u[2] / (4.0 * DRAG);
    double square[4] = {all - pitch - yaw, all - roll + yaw, all + pitch - yaw, all + roll + yaw};
    for (int i = 0; i < 4; i++) command[i] = square[i] > 0.0 ? sqrt(square[i]) : 0.0;
}

static void write_telemetry(Writer *w, const State x, long tick) {
    double euler[3];
    uint32_t ms = (uint32_t)(tick * TICK_US / 1000);
    if (tick % SLOWEST == 0) send_heartbeat(w, 2, 12);
    if (tick % SLOW == 0) {
        Payload p = {.length = 0};
        angles(x + 6, euler);
        put_u32(&p, ms);
        for (int i = 0; i < 3; i++) put_f(&p, euler[i]);
        for (int i = 0; i < 3; i++) put_f(&p, x[10 + i]);
        frame(w, ATTITUDE, &p);
        p.length = 0;
        put_u32(&p, ms);
        for (int i = 0; i < 4; i++) put_f(&p, x[6 + i]);
        for (int i = 0; i < 3; i++) put_f(&p, x[10 + i]);
        for (int i = 0; i < 4; i++) put_f(&p, 0.0);
        frame(w, ATTITUDE_QUATERNION, &p);
        p.length = 0;
        put_u32(&p, ms);
        for (int i = 0; i < 3; i++) put_f(&p, x[i]);
        for (int i = 0; i < 3; i++) put_f(&p, x[3 + i]);
        frame(w, LOCAL_POSITION_NED, &p);
    }
    Odometry o = {.stamp_us = (uint64_t)(tick * TICK_US), .frame_id = 1, .child_frame_id = 1, .estimator_type = 8,
                  .quality = 100};
    for (int i = 0; i < 3; i++) { o.position[i] = x[i]; o.velocity[i] = x[3 + i]; o.rates[i] = x[10 + i]; }
    for (int i = 0; i < 4; i++) o.q[i] = x[6 + i];
    o.pose_covariance[0] = o.velocity_covariance[0] = NAN;
    send_odometry(w, &o);
    if (tick % SLOWER == 0) {
        Payload p = {.length = 0};
        for (int i = 0; i < 3; i++) put_u32(&p, 0x1020000F);
        put_u16(&p, 200); put_u16(&p, 12000); put_u16(&p, 1500);
        for (int i = 0; i < 6; i++) put_u16(&p, 0);
        put_u8(&p, 90);
        for (int i = 0; i < 3; i++) put_u32(&p, 0);
        frame(w, SYS_STATUS, &p);
        p.length = 0;
        put_u8(&p, 0); put_u8(&p, 2);
        frame(w, EXTENDED_SYS_STATE, &p);
    }
}

/* Sockets and time */

static int connected(int local, int remote) {
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons((uint16_t)local)}, there = here;
    here.sin_addr.s_addr = there.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    there.sin_port = htons((uint16_t)remote);
    int opened = socket(AF_INET, SOCK_DGRAM, 0);
    struct timeval patience = {.tv_usec = 100000};
    if (opened < 0 || bind(opened, (struct sockaddr *)&here, sizeof here) ||
        connect(opened, (struct sockaddr *)&there, sizeof there) ||
        setsockopt(opened, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience)) {
        perror("exchange");
        exit(1);
    }
    return opened;
}

static double now_s(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void vehicle(int link, double seconds) {
    State x = {0.5, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0};
    for (int i = 13; i < 17; i++) x[i] = sqrt(MASS * GRAVITY / (4.0 * THRUST));
    Writer w = {.system = 1, .component = 1};
    Target target = {0};
    Payload payload;
    uint8_t bytes[DATAGRAM];
    long ticks = lround(seconds * 1e6 / TICK_US), out = 0, in = 0;
    double started = 0.0;
    for (long tick = 0; tick < ticks; tick++) {
        w.length = 0;
        write_telemetry(&w, x, tick);
        for (int answered = 0, patience = 100; !answered;) {
            if (!patience--) { fprintf(stderr, "exchange: no answer\n"); exit(1); }
            (void)!send(link, w.bytes, (size_t)w.length, 0); /* again after a time-out: the other end may be starting */
            out += w.length;
            ssize_t size = 0;
            errno = 0;
            while (!answered && (size = recv(link, bytes, sizeof bytes, 0)) > 0) {
                in += size;
                int32_t id;
                for (int offset = 0; (id = next(bytes, (int)size, &offset, &payload)) >= 0;)
                    if (id == SET_ATTITUDE_TARGET) {
                        read_target(&payload, &target);
                        answered = target.stamp_ms == (uint32_t)(tick * TICK_US / 1000);
                    }
            }
            if (!answered && errno == ECONNREFUSED) usleep(100000); /* it has not bound its port yet */
        }
        if (!tick) { started = now_s(); out = in = 0; }
        for (int step = 0; step < SUBSTEPS; step++) {
            double command[4];
            allocate(x, &target, command);
            rk4(x, command, TICK_US * 1e-6 / SUBSTEPS);
        }
    }
    double wall = now_s() - started;
    printf("%.6g %.6g %.6g %.6g\n", (double)(ticks - 1) * TICK_US * 1e-6 / wall,
           sqrt(x[0] * x[0] + x[1] * x[1] + (x[2] + 1.0) * (x[2] + 1.0)), (double)out / (double)(ticks - 1),
           (double)in / (double)(ticks - 1));
}

static void ground(int link) {
    Writer w = {.system = 250, .component = 191};
    Payload payload;
    uint8_t bytes[DATAGRAM];
    const double wanted[3] = {0.0, 0.0, -1.0}, dt = TICK_US * 1e-6;
    double integral[3] = {0}, euler[3], beat_s = 0.0;
    for (;;) {
        ssize_t size = recv(link, bytes, sizeof bytes, 0);
        if (size <= 0) continue; /* nothing yet */
        w.length = 0;
        int32_t id;
        for (int offset = 0; (id = next(bytes, (int)size, &offset, &payload)) >= 0;) {
            if (id != ODOMETRY) continue;
            Odometry o;
            read_odometry(&payload, &o);
            double acceleration[3];
            for (int i = 0; i < 3; i++) {
                double error = wanted[i] - o.position[i];
                integral[i] += dt * error;
                acceleration[i] = 6.0 * error + 0.2 * integral[i] - 4.5 * o.velocity[i];
            }
            angles(o.q, euler);
            double lift = GRAVITY - acceleration[2];
            Target t = {.stamp_ms = (uint32_t)(o.stamp_us / 1000), .q = {1.0}, .system = 1, .component = 1, .mask = 0x80};
            t.rates[0] = 10.0 * (atan2(acceleration[1], lift) - euler[0]);
            t.rates[1] = 10.0 * (atan2(-acceleration[0], lift) - euler[1]);
            t.rates[2] = 4.0 * -euler[2];
            t.thrust = fmax(0.0, fmin(1.0, MASS * lift / (cos(euler[0]) * cos(euler[1])) / MAX_THRUST));
            send_target(&w, &t);
            if ((double)o.stamp_us * 1e-6 >= beat_s) {
                send_heartbeat(&w, 18, 8);
                beat_s += 1.0;
            }
        }
        if (w.length) (void)!send(link, w.bytes, (size_t)w.length, 0);
    }
}

int main(int count, char **arguments) {
    if (count == 4 && !strcmp(arguments[1], "ground")) ground(connected(atoi(arguments[2]), atoi(arguments[3])));
    if (count != 5 || strcmp(arguments[1], "vehicle")) {
        fprintf(stderr, "exchange ground LOCAL REMOTE, or exchange vehicle LOCAL REMOTE SECONDS\n");
        return 2;
    }
    vehicle(connected(atoi(arguments[2]), atoi(arguments[3])), atof(arguments[4]));
    return 0;
}
