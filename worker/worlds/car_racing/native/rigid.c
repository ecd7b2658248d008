/* Rigid bodies as Box2D keeps them. */

#include "rigid.h"

void rigid_init(Rigid *body, Vec at, float angle)
{
    *body = (Rigid){.pose = {at, turn_by(angle)}, .at = at, .angle = angle, .awake = true};
}

void rigid_fix(Rigid *body, const Vec *points, int count)
{
    Fixture *fixture = &body->fixture[body->fixtures++];
    fixture->polygon = polygon_hull(points, count);
    polygon_place(&fixture->polygon, body->pose, fixture->world);
}

void rigid_weigh(Rigid *body, float density)
{
    float whole = 0, moment = 0;
    Vec centre = {0, 0};
    for (int i = body->fixtures - 1; i >= 0; i--) { /* the newest first: a sum in another order has other bits */
        Mass mass = polygon_mass(&body->fixture[i].polygon, density);
        whole += mass.mass;
        centre = vec_add(centre, vec_scale(mass.mass, mass.centre));
        moment += mass.moment;
    }
    body->by_mass = 1.0f / whole;
    body->centre = vec_scale(body->by_mass, centre);
    moment -= whole * vec_dot(body->centre, body->centre);
    body->by_inertia = 1.0f / moment;
    body->at = pose_out(body->pose, body->centre);
}

void rigid_wake(Rigid *body)
{
    if (!body->awake)
        body->still = 0;
    body->awake = true;
}

void rigid_rest(Rigid *body)
{
    body->awake = false;
    body->still = body->spin = 0;
    body->velocity = body->force = (Vec){0, 0};
}

Pose rigid_pose(const Rigid *body, Turn turn)
{
    return (Pose){vec_sub(body->at, turn_out(turn, body->centre)), turn};
}

void rigid_place(Rigid *body)
{
    body->pose = rigid_pose(body, turn_by(body->angle));
    for (int i = 0; i < body->fixtures; i++)
        polygon_place(&body->fixture[i].polygon, body->pose, body->fixture[i].world);
}
