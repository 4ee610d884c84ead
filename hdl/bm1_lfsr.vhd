-- ================================================================================================
-- rosbayes: bm1_lfsr
-- Random number generator: a Fibonacci LFSR with several steps per clock.
-- MIT licence; datasheet: docs/hardware/bm1_lfsr.md
-- ================================================================================================

library ieee;
  use ieee.std_logic_1164.all;

entity bm1_lfsr is
  generic (
    STATE_BITS : positive;         -- width of the register
    TAPS       : std_logic_vector; -- mask, STATE_BITS wide: a step shifts in the parity of the masked bits
    STEPS      : positive          -- steps per clock
  );
  port (
    clk_i   : in    std_logic;                                 -- clock
    shift_i : in    std_logic;                                 -- 1: load seed_i into the state
    seed_i  : in    std_logic_vector(STATE_BITS - 1 downto 0); -- seed from the memory or the previous generator
    step_i  : in    std_logic;                                 -- make STEPS steps
    state_o : out   std_logic_vector(STATE_BITS - 1 downto 0)  -- state; the low bits of the state are the random number
  );
end entity bm1_lfsr;

architecture rtl of bm1_lfsr is

  signal state : std_logic_vector(STATE_BITS - 1 downto 0) := (others => '0');

begin

  generate_numbers : process (clk_i) is

    variable following : std_logic_vector(STATE_BITS - 1 downto 0);

  begin

    if rising_edge(clk_i) then
      if (shift_i = '1') then
        state <= seed_i;
      elsif (step_i = '1') then
        following := state;

        for step in 1 to STEPS loop

          following := following(STATE_BITS - 2 downto 0) & (xor (following and TAPS));

        end loop;

        state <= following;
      end if;
    end if;

  end process generate_numbers;

  state_o <= state;

end architecture rtl;
