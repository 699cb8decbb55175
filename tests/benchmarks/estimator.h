/* The arithmetic of estimator/ for one joint, line by line in C: observer, losses, validity, network.
   Names and order follow the Python files; equations and reasons stand there. */
#ifndef ESTIMATOR_H
#define ESTIMATOR_H

#include <math.h>
#include <stdbool.h>
#include <string.h>

enum { OFF = 0, STARTING = 1, VALID = 2, DEGRADED = 3, STALE = 4, DRIVE_FAULT = 5, STANDSTILL = 6, INVALID = 15 };
enum { INPUTS = 6, LAYER_1 = 20, LAYER_2 = 40, LAYER_3 = 10 };

/* c00 c10 c01 c20 c11 c02 in |i| and |v|, eta low and high, |i| max, rmse; index: 2 when v < 0, plus 1 when i < 0 */
typedef double quadrant[10];

typedef struct {
    double w1[INPUTS][LAYER_1], b1[LAYER_1], w2[LAYER_1][LAYER_2], b2[LAYER_2], w3[LAYER_2][LAYER_3], b3[LAYER_3];
    double w4[LAYER_3], b4, input_mean[INPUTS], input_std[INPUTS], output_mean, output_std;
} network_weights;

typedef struct {
    double gear, inverse_gear, kt, inertia_rate, rate, link_rate;
    double coulomb, stribeck, viscous, inverse_stribeck, inverse_w0, static_friction;
    quadrant quadrants[4];
    double torque_per_ampere, inverse_gain, inverse_blend, no_blend;
    double floor, u_friction, limit, raw_limit, link_speed_limit, stop, leave, max_gap;
    double low[INPUTS], high[INPUTS], inverse_margin[INPUTS], distance_limit, fade, inverse_fade, network_sigma;
    network_weights network;
} joint_parameters;

typedef struct {
    double u, z, v, z_v, friction_last, z_friction, link, link_velocity;
    bool running, standing;
} joint_state;

typedef struct {
    double torque, sigma, tob, efficiency, network;
    int status;
} estimate;

static double friction_torque(const joint_parameters *p, double v)
{
    double x = v * p->inverse_stribeck;
    return tanh(v * p->inverse_w0) * (p->coulomb + p->stribeck * exp(-x * x)) + p->viscous * v;
}

static const double *quadrant_of(const joint_parameters *p, double i, double v)
{
    return p->quadrants[2 * (v < 0.0) + (i < 0.0)];
}

static double eta(const joint_parameters *p, double i, double v)
{
    const double *q = quadrant_of(p, i, v);
    double a = fmin(fabs(i), q[8]), w = fmin(fmax(fabs(v), 0.2), 3.0);
    return fmin(fmax(q[0] + (q[1] + q[3] * a + q[4] * w) * a + (q[2] + q[5] * w) * w, q[6]), q[7]);
}

static double loss(const joint_parameters *p, double i, double v)
{
    double a = fabs(i), w = fabs(v), size = p->torque_per_ampere * a * fabs(1.0 - eta(p, i, v));
    if (w < 0.5)
        size *= tanh(w * 50.0);
    if (a < p->no_blend) {
        double r = a * p->inverse_blend;
        size += exp(-r * r) * (friction_torque(p, w) - size);
    }
    return v < 0.0 ? -size : size;
}

static double moving_sigma(const joint_parameters *p, double i, double v)
{
    double load = quadrant_of(p, i, v)[9] * p->torque_per_ampere * fabs(i);
    double friction = p->u_friction * friction_torque(p, v);
    return sqrt(load * load + friction * friction + p->floor * p->floor);
}

static void standing(const joint_parameters *p, double raw, double i, double *torque, double *sigma)
{
    double load = p->torque_per_ampere * fabs(i), r = i * p->inverse_blend, weight = exp(-r * r);
    double forward = load * fabs(1.0 - eta(p, i, 0.0)), backward = load * fabs(1.0 - eta(p, i, -1e-300));
    forward += weight * (p->static_friction - forward);
    backward = -(backward + weight * (p->static_friction - backward));
    *torque = raw - 0.5 * (forward + backward);
    *sigma = 0.5 * (1.0 + p->u_friction) * (forward - backward) + p->floor;
}

static double run_network(const network_weights *n, const double x[INPUTS])
{
    double h1[LAYER_1], h2[LAYER_2], h3[LAYER_3], y = n->b4;
    memcpy(h1, n->b1, sizeof h1);
    for (int k = 0; k < INPUTS; k++) {
        double value = (x[k] - n->input_mean[k]) / n->input_std[k];
        for (int j = 0; j < LAYER_1; j++)
            h1[j] += value * n->w1[k][j];
    }
    memcpy(h2, n->b2, sizeof h2);
    for (int k = 0; k < LAYER_1; k++) {
        double value = tanh(0.5 * h1[k]);
        for (int j = 0; j < LAYER_2; j++)
            h2[j] += value * n->w2[k][j];
    }
    memcpy(h3, n->b3, sizeof h3);
    for (int k = 0; k < LAYER_2; k++) {
        double value = tanh(0.5 * h2[k]);
        for (int j = 0; j < LAYER_3; j++)
            h3[j] += value * n->w3[k][j];
    }
    for (int k = 0; k < LAYER_3; k++)
        y += tanh(0.5 * h3[k]) * n->w4[k];
    return y * n->output_std + n->output_mean;
}

static double trust(const joint_parameters *p, const double x[INPUTS], double difference)
{
    double weight = 1.0, distance = fabs(difference);
    for (int k = 0; k < INPUTS; k++) {
        double excess = fmax(p->low[k] - x[k], x[k] - p->high[k]);
        if (excess > 0.0)
            weight = fmin(weight, 1.0 - excess * p->inverse_margin[k]);
    }
    weight = fmax(weight, 0.0);
    if (distance <= p->fade)
        return weight;
    return distance < p->distance_limit ? fmin((p->distance_limit - distance) * p->inverse_fade, weight) : 0.0;
}

static estimate nothing(int status)
{
    return (estimate){NAN, NAN, NAN, NAN, NAN, status};
}

static estimate start(const joint_parameters *p, joint_state *s, double i, double omega, double link)
{
    double v = omega * p->inverse_gear;
    s->u = s->z = i * p->kt + p->inertia_rate * omega;
    s->v = s->z_v = v;
    s->friction_last = s->z_friction = friction_torque(p, v);
    s->link = link;
    s->link_velocity = v;
    s->running = true;
    s->standing = fabs(v) < p->stop;
    return nothing(STARTING);
}

static estimate step(const joint_parameters *p, joint_state *s, double dt, double i, double theta, double omega, double link)
{
    if (!isfinite(i + theta + omega + link)) {
        s->running = false;
        return nothing(INVALID);
    }
    if (!s->running || !(dt > 0.0 && dt <= p->max_gap))
        return start(p, s, i, omega, link);
    double x = p->rate * dt, gone = -expm1(-x), share = gone / x, a = 1.0 - gone, b0 = 1.0 - share, b1 = share - a;
    double spin = p->inertia_rate * omega, u = i * p->kt + spin, v = omega * p->inverse_gear, f = friction_torque(p, v);
    s->z = a * s->z + b0 * u + b1 * s->u;
    s->z_v = a * s->z_v + b0 * v + b1 * s->v;
    s->z_friction = a * s->z_friction + b0 * f + b1 * s->friction_last;
    s->u = u, s->v = v, s->friction_last = f;
    s->link_velocity += -expm1(-p->link_rate * dt) * ((link - s->link) / dt - s->link_velocity);
    s->link = link;
    double raw = (s->z - spin) * p->gear, speed = s->z_v;
    if (!(fabs(raw) <= p->raw_limit && fabs(s->link_velocity) <= p->link_speed_limit)) {
        s->running = false;
        return nothing(INVALID);
    }
    if (fabs(speed) <= p->leave)
        s->standing = s->standing || fabs(speed) < p->stop;
    else
        s->standing = false;
    double equivalent = raw * p->inverse_gain, physics = raw - loss(p, equivalent, speed);
    double features[INPUTS] = {i, theta, omega, link, s->link_velocity, physics};
    double network = run_network(&p->network, features), weight = trust(p, features, network - physics);
    estimate e = {physics, 0.0, raw - s->z_friction, physics, network, VALID};
    if (s->standing) {
        standing(p, raw, equivalent, &e.torque, &e.sigma);
        e.status = STANDSTILL;
    } else if (weight == 1.0) {
        e.torque = network, e.sigma = p->network_sigma;
    } else {
        double sigma = moving_sigma(p, equivalent, speed);
        e.torque = physics + weight * (network - physics);
        e.sigma = sigma + weight * (p->network_sigma - sigma);
        if (!(weight > 0.0))
            e.torque = physics, e.sigma = sigma, e.status = DEGRADED;
    }
    if (!(fabs(e.torque) <= p->limit))
        e.torque = e.sigma = NAN, e.status = INVALID;
    return e;
}

#endif
