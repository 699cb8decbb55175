/* Estimate of jtqd for a controller in C99: one header, no allocation, no system call.
 *
 *     jtqd_receiver receiver;
 *     jtqd_begin(&receiver, 0x20, 240, 5000000);               node-ID, counter overflow (1019h), age limit [ns]
 *     jtqd_take(&receiver, frame.can_id, frame.data, frame.can_dlc, stamp_ns);      every frame, with its time stamp
 *     jtqd_torque now = jtqd_read(&receiver, 1, now_ns);                            every control cycle
 *     if (now.usable) ... now.torque_nm, now.sigma_nm; else ... jtqd_reason_name(now.reason)
 *
 * The estimate PDO is sent in each cycle with COB-ID 180h + node for joints 1 and 2, and with 280h + node for joints 3
 * and 4 where jtqd has them: torque I16 and I16 [0.01 Nm], sigma U8 and U8 [0.05 Nm], status (low nibble: first joint),
 * SYNC counter of the inputs. docs/bus.md describes it, docs/safety.md what a receiver must do.
 *
 * With section `contact` the contact PDO follows it, COB-ID 380h + node (joints 1 and 2) and 480h + node (3 and 4): torque
 * rate I8 and I8 [32 Nm/s], contact (low nibble: first joint), SYNC counter. docs/estimator.md says what it can promise.
 *     jtqd_contact touched = jtqd_read_contact(&receiver, 1, now_ns);
 *     if (touched.code >= JTQD_CONTACT_POSITIVE) ... stop; else if (touched.code != JTQD_CONTACT_NONE) ... nothing is known
 *
 * A torque is usable only when all of this holds:
 *   - status 2 (valid), 3 (degraded) or 6 (standstill), and the torque field is not 8000h;
 *   - its SYNC counter is that of the last SYNC or of the one before (checked once a SYNC with a counter was taken);
 *   - it is not older than the limit, counted from the SYNC of its inputs, else from its own arrival;
 *   - its SYNC counter is another one than in the PDO before: a repeated PDO is not a new estimate.
 * Time stamps are in ns of any one clock. Take the kernel's (SO_TIMESTAMPNS), not the time of the read: frames that have
 * waited in the queue of a delayed process would look young. A stamp later than now makes the torque unusable.
 */
#ifndef JTQD_ESTIMATE_H
#define JTQD_ESTIMATE_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

enum {
    JTQD_OFF = 0,
    JTQD_STARTING = 1,
    JTQD_VALID = 2,
    JTQD_DEGRADED = 3,   /* physics without the network's full share: a wider sigma */
    JTQD_STALE = 4,
    JTQD_DRIVE_FAULT = 5,
    JTQD_STANDSTILL = 6, /* an interval: sigma is its half width */
    JTQD_INVALID = 15,
};

enum {
    JTQD_CONTACT_OFF = 0,     /* nobody watches */
    JTQD_CONTACT_UNKNOWN = 1, /* also: too old, or no PDO yet */
    JTQD_CONTACT_NONE = 2,    /* the only one that says that there is none */
    JTQD_CONTACT_POSITIVE = 3, /* pushed along the joint's positive direction */
    JTQD_CONTACT_NEGATIVE = 4,
};

enum { JTQD_SYNC = 0x080, JTQD_LENGTH = 8, JTQD_CONTACT_LENGTH = 4, JTQD_JOINTS = 4, JTQD_PDOS = 2 };

/* Why a torque is not usable. */
typedef enum {
    JTQD_USABLE = 0,
    JTQD_NEVER_RECEIVED,
    JTQD_WITHHELD, /* by its status */
    JTQD_TOO_OLD,  /* no new PDO within the limit */
    JTQD_BEHIND,   /* not of the last two SYNCs */
    JTQD_CLOCK,    /* its stamp is later than now: the clock was set back */
} jtqd_reason;

/* One joint as one PDO tells it. Without a torque it is NaN; an unknown sigma is infinite. */
typedef struct {
    uint8_t status;
    bool has_torque;
    double torque_nm;
    double sigma_nm;
} jtqd_joint;

/* One PDO: two joints and the SYNC counter of their inputs. */
typedef struct {
    jtqd_joint joint[2];
    uint8_t sequence;
} jtqd_estimate;

/* What the controller may use now. */
typedef struct {
    bool usable;
    jtqd_reason reason;
    uint8_t status;
    double torque_nm; /* NaN where it is not usable */
    double sigma_nm;
    int64_t age_ns; /* since the SYNC of its inputs, or since its arrival where no SYNC is received */
} jtqd_torque;

/* One contact PDO: two joints and the SYNC counter of their inputs. */
typedef struct {
    uint8_t code[2];
    double rate_nm_s[2]; /* NaN: none; what is beyond +-4064 stands there */
    uint8_t sequence;
} jtqd_contacts;

/* What is known now about a contact of one joint. */
typedef struct {
    uint8_t code;     /* JTQD_CONTACT_... */
    double rate_nm_s; /* of the torque; NaN where it is not known */
    int64_t age_ns;   /* as in jtqd_torque */
} jtqd_contact;

typedef struct {
    jtqd_estimate last;
    bool any;
    int64_t stamp_ns;  /* arrival of the newest estimate */
    int64_t inputs_ns; /* SYNC of its inputs, or arrival */
} jtqd_pdo;

typedef struct {
    jtqd_contacts last;
    bool any;
    int64_t stamp_ns, inputs_ns; /* as above */
} jtqd_contact_pdo;

typedef struct {
    /* settings */
    uint16_t node;
    uint8_t overflow;
    int64_t max_age_ns;
    /* state */
    jtqd_pdo pdo[JTQD_PDOS];
    jtqd_contact_pdo contact[JTQD_PDOS];
    bool counted_sync; /* a SYNC with a counter was taken */
    uint8_t sync;
    int64_t sync_ns, sync_before_ns;
    /* counters */
    uint64_t received, lost, repeated, malformed; /* lost: at least, by gaps of the SYNC counter */
    uint64_t contacts;                            /* contact PDOs received */
} jtqd_receiver;

static inline const char *jtqd_status_name(uint8_t status)
{
    static const char *const NAMES[16] = {
        "off", "starting", "valid", "degraded", "stale", "drive_fault", "standstill",
        "unknown", "unknown", "unknown", "unknown", "unknown", "unknown", "unknown", "unknown",
        "invalid",
    };
    return NAMES[status & 0x0F];
}

static inline const char *jtqd_reason_name(jtqd_reason reason)
{
    static const char *const NAMES[] = {"usable", "never received", "withheld", "too old", "behind SYNC", "clock"};
    return NAMES[reason];
}

static inline const char *jtqd_contact_name(uint8_t code)
{
    static const char *const NAMES[] = {"off", "unknown", "none", "positive", "negative"};
    return NAMES[code <= JTQD_CONTACT_NEGATIVE ? code : (uint8_t)JTQD_CONTACT_UNKNOWN];
}

static inline jtqd_joint jtqd_decode_joint(const uint8_t torque[2], uint8_t sigma, uint8_t status)
{
    const uint16_t raw = (uint16_t)(torque[0] | torque[1] << 8);
    const bool published = status == JTQD_VALID || status == JTQD_DEGRADED || status == JTQD_STANDSTILL;
    jtqd_joint joint = {status, published && raw != 0x8000u, NAN, sigma == 255 ? INFINITY : 0.05 * sigma};

    if (joint.has_torque)
        joint.torque_nm = 0.01 * (raw < 0x8000u ? (int32_t)raw : (int32_t)raw - 0x10000);
    return joint;
}

/* Decode the data of a PDO; false for another length than 8. */
static inline bool jtqd_decode(const uint8_t *data, size_t length, jtqd_estimate *result)
{
    if (length != JTQD_LENGTH)
        return false;
    result->joint[0] = jtqd_decode_joint(data, data[4], data[6] & 0x0F);
    result->joint[1] = jtqd_decode_joint(data + 2, data[5], data[6] >> 4);
    result->sequence = data[7];
    return true;
}

/* Decode the data of a contact PDO; false for another length than 4. A code of a later version is not known. */
static inline bool jtqd_decode_contacts(const uint8_t *data, size_t length, jtqd_contacts *result)
{
    if (length != JTQD_CONTACT_LENGTH)
        return false;
    for (int joint = 0; joint < 2; joint++) {
        const uint8_t code = joint == 0 ? data[2] & 0x0F : data[2] >> 4;
        result->code[joint] = code <= JTQD_CONTACT_NEGATIVE ? code : (uint8_t)JTQD_CONTACT_UNKNOWN;
        result->rate_nm_s[joint] = data[joint] == 0x80 ? NAN : 32.0 * (data[joint] < 0x80 ? data[joint] : data[joint] - 256);
    }
    result->sequence = data[3];
    return true;
}

/* Begin. node: jtqd's node-ID (20h); overflow: `sync.counter_overflow` of its configuration. */
static inline void jtqd_begin(jtqd_receiver *receiver, uint8_t node, uint8_t overflow, int64_t max_age_ns)
{
    memset(receiver, 0, sizeof *receiver);
    receiver->node = node;
    receiver->overflow = overflow;
    receiver->max_age_ns = max_age_ns;
}

/* Steps from one SYNC counter to another: 1..overflow, then 1 again. */
static inline int jtqd_steps(const jtqd_receiver *receiver, uint8_t from, uint8_t to)
{
    return to >= from ? to - from : to - from + receiver->overflow;
}

/* Whether a number can be a SYNC counter. */
static inline bool jtqd_counter(const jtqd_receiver *receiver, uint8_t value)
{
    return value >= 1 && value <= receiver->overflow;
}

/* When the inputs of a PDO were taken: the SYNC with its counter, else its arrival. */
static inline int64_t jtqd_inputs(const jtqd_receiver *receiver, uint8_t sequence, int64_t stamp_ns)
{
    const int behind = receiver->counted_sync ? jtqd_steps(receiver, sequence, receiver->sync) : -1;
    return behind == 0 ? receiver->sync_ns : behind == 1 ? receiver->sync_before_ns : stamp_ns;
}

static inline int jtqd_take_contacts(jtqd_receiver *receiver, int number, const uint8_t *data, size_t length,
                                     int64_t stamp_ns)
{
    jtqd_contact_pdo *pdo = &receiver->contact[number];
    jtqd_contacts told;

    if (!jtqd_decode_contacts(data, length, &told) || !jtqd_counter(receiver, told.sequence)) {
        receiver->malformed++;
        return 0;
    }
    if (pdo->any && told.sequence == pdo->last.sequence) {
        /* Not a new one, so its age stays; but what is worse than "none" is heard. */
        for (int joint = 0; joint < 2; joint++)
            if (told.code[joint] != JTQD_CONTACT_NONE && pdo->last.code[joint] < JTQD_CONTACT_POSITIVE)
                pdo->last.code[joint] = told.code[joint];
        receiver->repeated++;
        return 0;
    }
    pdo->inputs_ns = jtqd_inputs(receiver, told.sequence, stamp_ns);
    pdo->last = told;
    pdo->any = true;
    pdo->stamp_ns = stamp_ns;
    receiver->contacts++;
    return JTQD_PDOS + number + 1;
}

/* Take a data frame with an 11-bit identifier; others are ignored.
 * Return 1 or 2 for a new estimate PDO, 3 or 4 for a new contact PDO, else 0. */
static inline int jtqd_take(jtqd_receiver *receiver, uint32_t can_id, const uint8_t *data, size_t length,
                            int64_t stamp_ns)
{
    if (can_id == JTQD_SYNC) {
        receiver->counted_sync = length == 1 && jtqd_counter(receiver, data[0]);
        if (receiver->counted_sync) {
            const bool next = jtqd_steps(receiver, receiver->sync, data[0]) == 1;
            receiver->sync_before_ns = next ? receiver->sync_ns : stamp_ns;
            receiver->sync = data[0];
            receiver->sync_ns = stamp_ns;
        }
        return 0;
    }
    for (int number = 0; number < JTQD_PDOS; number++) {
        jtqd_pdo *pdo = &receiver->pdo[number];
        jtqd_estimate estimate;

        if (can_id == (number == 0 ? 0x380u : 0x480u) + receiver->node)
            return jtqd_take_contacts(receiver, number, data, length, stamp_ns);
        if (can_id != (number == 0 ? 0x180u : 0x280u) + receiver->node)
            continue;
        if (!jtqd_decode(data, length, &estimate) || !jtqd_counter(receiver, estimate.sequence)) {
            receiver->malformed++;
            return 0;
        }
        if (pdo->any && estimate.sequence == pdo->last.sequence) {
            /* Not a new estimate, so its age stays; but a status that has become worse is heard. */
            for (int joint = 0; joint < 2; joint++)
                if (!estimate.joint[joint].has_torque)
                    pdo->last.joint[joint] = estimate.joint[joint];
            receiver->repeated++;
            return 0;
        }
        if (pdo->any)
            receiver->lost += (uint64_t)(jtqd_steps(receiver, pdo->last.sequence, estimate.sequence) - 1);
        pdo->inputs_ns = jtqd_inputs(receiver, estimate.sequence, stamp_ns);
        pdo->last = estimate;
        pdo->any = true;
        pdo->stamp_ns = stamp_ns;
        receiver->received++;
        return number + 1;
    }
    return 0;
}

/* What the controller may use of joint 1..4 at the time now_ns. */
static inline jtqd_torque jtqd_read(const jtqd_receiver *receiver, int joint, int64_t now_ns)
{
    jtqd_torque result = {false, JTQD_NEVER_RECEIVED, JTQD_OFF, NAN, INFINITY, 0};

    if (joint < 1 || joint > JTQD_JOINTS || !receiver->pdo[(joint - 1) / 2].any)
        return result;
    const jtqd_pdo *pdo = &receiver->pdo[(joint - 1) / 2];
    const jtqd_joint *told = &pdo->last.joint[(joint - 1) % 2];
    result.status = told->status;
    result.sigma_nm = told->sigma_nm;
    result.age_ns = now_ns - pdo->inputs_ns;
    if (now_ns < pdo->stamp_ns || now_ns < pdo->inputs_ns)
        result.reason = JTQD_CLOCK;
    else if (result.age_ns > receiver->max_age_ns)
        result.reason = JTQD_TOO_OLD;
    else if (!told->has_torque)
        result.reason = JTQD_WITHHELD;
    else if (receiver->counted_sync && jtqd_steps(receiver, pdo->last.sequence, receiver->sync) > 1)
        result.reason = JTQD_BEHIND;
    else {
        result.reason = JTQD_USABLE;
        result.usable = true;
        result.torque_nm = told->torque_nm;
    }
    return result;
}

/* What is known of a contact of joint 1..4 at the time now_ns: not known where the PDO is too old or of an earlier SYNC. */
static inline jtqd_contact jtqd_read_contact(const jtqd_receiver *receiver, int joint, int64_t now_ns)
{
    jtqd_contact result = {JTQD_CONTACT_UNKNOWN, NAN, 0};

    if (joint < 1 || joint > JTQD_JOINTS || !receiver->contact[(joint - 1) / 2].any)
        return result;
    const jtqd_contact_pdo *pdo = &receiver->contact[(joint - 1) / 2];
    result.age_ns = now_ns - pdo->inputs_ns;
    if (now_ns < pdo->stamp_ns || now_ns < pdo->inputs_ns || result.age_ns > receiver->max_age_ns ||
        (receiver->counted_sync && jtqd_steps(receiver, pdo->last.sequence, receiver->sync) > 1))
        return result;
    result.code = pdo->last.code[(joint - 1) % 2];
    result.rate_nm_s = pdo->last.rate_nm_s[(joint - 1) % 2];
    return result;
}

#endif
