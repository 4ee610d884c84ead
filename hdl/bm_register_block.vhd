-- ================================================================================================
-- rosbayes: bm_register_block
-- Registers of a board: stores what software writes and selects what it reads.
-- Generated from hdl/bm_registers.rdl by scripts/registers: change that file, not this one.
-- MIT licence; datasheet: docs/hardware/bm_register_block.md
-- ================================================================================================
library ieee;
  use ieee.std_logic_1164.all;
  use ieee.numeric_std.all;

library work;
  use work.bm_register_map.all;

entity bm_register_block is
  port (
    clk_i   : in    std_logic; -- clock
    rst_i   : in    std_logic; -- reset of the board
    write_i : in    std_logic; -- write the word; it must be allowed
    read_i  : in    std_logic; -- read the word
    word_i  : in    std_logic_vector(7 downto 0); -- number of the word: address / 4
    data_i  : in    std_logic_vector(31 downto 0); -- data to write
    data_o  : out   std_logic_vector(31 downto 0); -- data read, a clock after read_i
    liveness_i : in    std_logic_vector(31 downto 0); -- Liveness, as read
    liveness_o : out   std_logic_vector(31 downto 0); -- Liveness, as written
    programmed_i : in    std_logic_vector(31 downto 0); -- Programmings, as read
    map_hash_i : in    std_logic_vector(255 downto 0); -- Hash of the map's definition, as read
    image_hash_i : in    std_logic_vector(255 downto 0); -- Hash of the image, as read
    cap_machine_i : in    std_logic_vector(31 downto 0); -- Machine, as read
    cap_lines_i : in    std_logic_vector(31 downto 0); -- Lines on this board, as read
    cap_total_lines_i : in    std_logic_vector(31 downto 0); -- Lines of the whole model, as read
    cap_line_offset_i : in    std_logic_vector(31 downto 0); -- First line of this board, as read
    cap_partition_i : in    std_logic_vector(31 downto 0); -- Partition, as read
    cap_sensors_i : in    std_logic_vector(31 downto 0); -- Sensor columns, as read
    cap_widths_i : in    std_logic_vector(31 downto 0); -- Widths, as read
    cap_banks_i : in    std_logic_vector(31 downto 0); -- RNG banks, as read
    cap_replicas_i : in    std_logic_vector(31 downto 0); -- Replicas, as read
    cap_interface_i : in    std_logic_vector(31 downto 0); -- Interface, as read
    cap_speed_i : in    std_logic_vector(31 downto 0); -- Speed, as read
    cap_steps_i : in    std_logic_vector(31 downto 0); -- Steps of the RNGs, as read
    cap_sensor_bits_i : in    std_logic_vector(511 downto 0); -- Widths of the sensors' addresses, as read
    control_o : out   std_logic_vector(31 downto 0); -- Control, as written
    target_count_o : out   std_logic_vector(31 downto 0); -- Target count, as written
    max_cycles_o : out   std_logic_vector(63 downto 0); -- Most cycles of a frame, as written
    bank_o : out   std_logic_vector(31 downto 0); -- RNG bank, as written
    prior_select_o : out   std_logic_vector(31 downto 0); -- Prior select, as written
    run_until_o : out   std_logic_vector(63 downto 0); -- End of the slice, as written
    start_o : out   std_logic_vector(31 downto 0); -- Start, as written
    resume_o : out   std_logic_vector(31 downto 0); -- Resume, as written
    done_i : in    std_logic_vector(31 downto 0); -- Done, as read
    status_i : in    std_logic_vector(31 downto 0); -- Status, as read
    cycles_i : in    std_logic_vector(63 downto 0); -- Cycles, as read
    compute_ns_i : in    std_logic_vector(63 downto 0); -- Time computed, as read
    halt_o : out   std_logic_vector(255 downto 0) -- Replicas to halt, as written
  );
end entity bm_register_block;

architecture rtl of bm_register_block is

  signal liveness : std_logic_vector(31 downto 0) := x"00000000";
  signal control : std_logic_vector(31 downto 0) := x"00000000";
  signal target_count : std_logic_vector(31 downto 0) := x"00000000";
  signal max_cycles : std_logic_vector(63 downto 0) := x"00000000" & x"00000000";
  signal bank : std_logic_vector(31 downto 0) := x"00000000";
  signal prior_select : std_logic_vector(31 downto 0) := x"00000000";
  signal run_until : std_logic_vector(63 downto 0) := x"00000000" & x"00000000";
  signal start : std_logic_vector(31 downto 0) := x"00000000";
  signal resume : std_logic_vector(31 downto 0) := x"00000000";
  signal cycles_high : std_logic_vector(31 downto 0) := (others => '0');
  signal cycles_held : std_logic := '0';
  signal compute_ns_high : std_logic_vector(31 downto 0) := (others => '0');
  signal compute_ns_held : std_logic := '0';
  signal halt : std_logic_vector(255 downto 0) := x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000";

begin

  store : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      control(0) <= '0';
      if (rst_i = '1') then
        liveness <= x"00000000";
        control <= x"00000000";
        target_count <= x"00000000";
        max_cycles <= x"00000000" & x"00000000";
        bank <= x"00000000";
        prior_select <= x"00000000";
        run_until <= x"00000000" & x"00000000";
        start <= x"00000000";
        resume <= x"00000000";
        halt <= x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000" & x"00000000";
      elsif (write_i = '1') then

        case to_integer(unsigned(word_i)) is

          when LIVENESS_ADDRESS / 4 =>

            liveness(31 downto 0) <= data_i(31 downto 0);

          when CONTROL_ADDRESS / 4 =>

            control(1 downto 0) <= data_i(1 downto 0);

          when TARGET_COUNT_ADDRESS / 4 =>

            target_count(31 downto 0) <= data_i(31 downto 0);

          when MAX_CYCLES_ADDRESS / 4 =>

            max_cycles(31 downto 0) <= data_i(31 downto 0);

          when MAX_CYCLES_ADDRESS / 4 + 1 =>

            max_cycles(63 downto 32) <= data_i(31 downto 0);

          when BANK_ADDRESS / 4 =>

            bank(31 downto 0) <= data_i(31 downto 0);

          when PRIOR_SELECT_ADDRESS / 4 =>

            prior_select(31 downto 0) <= data_i(31 downto 0);

          when RUN_UNTIL_ADDRESS / 4 =>

            run_until(31 downto 0) <= data_i(31 downto 0);

          when RUN_UNTIL_ADDRESS / 4 + 1 =>

            run_until(63 downto 32) <= data_i(31 downto 0);

          when START_ADDRESS / 4 =>

            start(31 downto 0) <= data_i(31 downto 0);

          when RESUME_ADDRESS / 4 =>

            resume(31 downto 0) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 =>

            halt(31 downto 0) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 1 =>

            halt(63 downto 32) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 2 =>

            halt(95 downto 64) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 3 =>

            halt(127 downto 96) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 4 =>

            halt(159 downto 128) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 5 =>

            halt(191 downto 160) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 6 =>

            halt(223 downto 192) <= data_i(31 downto 0);

          when HALT_ADDRESS / 4 + 7 =>

            halt(255 downto 224) <= data_i(31 downto 0);

          when others =>

            null;

        end case;

      end if;
    end if;

  end process store;

  liveness_o <= liveness;
  control_o <= control;
  target_count_o <= target_count;
  max_cycles_o <= max_cycles;
  bank_o <= bank;
  prior_select_o <= prior_select;
  run_until_o <= run_until;
  start_o <= start;
  resume_o <= resume;
  halt_o <= halt;

  select_word : process (clk_i) is
  begin

    if rising_edge(clk_i) then
      if (read_i = '1') then

        case to_integer(unsigned(word_i)) is

          when ID_ADDRESS / 4 =>

            data_o <= x"31304D42";

          when MAP_VERSION_ADDRESS / 4 =>

            data_o <= x"00010001";

          when LIVENESS_ADDRESS / 4 =>

            data_o <= liveness_i(31 downto 0);

          when PROGRAMMED_ADDRESS / 4 =>

            data_o <= programmed_i(31 downto 0);

          when MAP_HASH_ADDRESS / 4 =>

            data_o <= map_hash_i(31 downto 0);

          when MAP_HASH_ADDRESS / 4 + 1 =>

            data_o <= map_hash_i(63 downto 32);

          when MAP_HASH_ADDRESS / 4 + 2 =>

            data_o <= map_hash_i(95 downto 64);

          when MAP_HASH_ADDRESS / 4 + 3 =>

            data_o <= map_hash_i(127 downto 96);

          when MAP_HASH_ADDRESS / 4 + 4 =>

            data_o <= map_hash_i(159 downto 128);

          when MAP_HASH_ADDRESS / 4 + 5 =>

            data_o <= map_hash_i(191 downto 160);

          when MAP_HASH_ADDRESS / 4 + 6 =>

            data_o <= map_hash_i(223 downto 192);

          when MAP_HASH_ADDRESS / 4 + 7 =>

            data_o <= map_hash_i(255 downto 224);

          when IMAGE_HASH_ADDRESS / 4 =>

            data_o <= image_hash_i(31 downto 0);

          when IMAGE_HASH_ADDRESS / 4 + 1 =>

            data_o <= image_hash_i(63 downto 32);

          when IMAGE_HASH_ADDRESS / 4 + 2 =>

            data_o <= image_hash_i(95 downto 64);

          when IMAGE_HASH_ADDRESS / 4 + 3 =>

            data_o <= image_hash_i(127 downto 96);

          when IMAGE_HASH_ADDRESS / 4 + 4 =>

            data_o <= image_hash_i(159 downto 128);

          when IMAGE_HASH_ADDRESS / 4 + 5 =>

            data_o <= image_hash_i(191 downto 160);

          when IMAGE_HASH_ADDRESS / 4 + 6 =>

            data_o <= image_hash_i(223 downto 192);

          when IMAGE_HASH_ADDRESS / 4 + 7 =>

            data_o <= image_hash_i(255 downto 224);

          when CAP_MACHINE_ADDRESS / 4 =>

            data_o <= cap_machine_i(31 downto 0);

          when CAP_LINES_ADDRESS / 4 =>

            data_o <= cap_lines_i(31 downto 0);

          when CAP_TOTAL_LINES_ADDRESS / 4 =>

            data_o <= cap_total_lines_i(31 downto 0);

          when CAP_LINE_OFFSET_ADDRESS / 4 =>

            data_o <= cap_line_offset_i(31 downto 0);

          when CAP_PARTITION_ADDRESS / 4 =>

            data_o <= cap_partition_i(31 downto 0);

          when CAP_SENSORS_ADDRESS / 4 =>

            data_o <= cap_sensors_i(31 downto 0);

          when CAP_WIDTHS_ADDRESS / 4 =>

            data_o <= cap_widths_i(31 downto 0);

          when CAP_BANKS_ADDRESS / 4 =>

            data_o <= cap_banks_i(31 downto 0);

          when CAP_REPLICAS_ADDRESS / 4 =>

            data_o <= cap_replicas_i(31 downto 0);

          when CAP_INTERFACE_ADDRESS / 4 =>

            data_o <= cap_interface_i(31 downto 0);

          when CAP_SPEED_ADDRESS / 4 =>

            data_o <= cap_speed_i(31 downto 0);

          when CAP_STEPS_ADDRESS / 4 =>

            data_o <= cap_steps_i(31 downto 0);

          when CAP_SENSOR_BITS_ADDRESS / 4 =>

            data_o <= cap_sensor_bits_i(31 downto 0);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 1 =>

            data_o <= cap_sensor_bits_i(63 downto 32);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 2 =>

            data_o <= cap_sensor_bits_i(95 downto 64);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 3 =>

            data_o <= cap_sensor_bits_i(127 downto 96);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 4 =>

            data_o <= cap_sensor_bits_i(159 downto 128);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 5 =>

            data_o <= cap_sensor_bits_i(191 downto 160);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 6 =>

            data_o <= cap_sensor_bits_i(223 downto 192);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 7 =>

            data_o <= cap_sensor_bits_i(255 downto 224);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 8 =>

            data_o <= cap_sensor_bits_i(287 downto 256);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 9 =>

            data_o <= cap_sensor_bits_i(319 downto 288);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 10 =>

            data_o <= cap_sensor_bits_i(351 downto 320);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 11 =>

            data_o <= cap_sensor_bits_i(383 downto 352);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 12 =>

            data_o <= cap_sensor_bits_i(415 downto 384);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 13 =>

            data_o <= cap_sensor_bits_i(447 downto 416);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 14 =>

            data_o <= cap_sensor_bits_i(479 downto 448);

          when CAP_SENSOR_BITS_ADDRESS / 4 + 15 =>

            data_o <= cap_sensor_bits_i(511 downto 480);

          when CONTROL_ADDRESS / 4 =>

            data_o <= control(31 downto 0) and x"00000002";

          when TARGET_COUNT_ADDRESS / 4 =>

            data_o <= target_count(31 downto 0);

          when MAX_CYCLES_ADDRESS / 4 =>

            data_o <= max_cycles(31 downto 0);

          when MAX_CYCLES_ADDRESS / 4 + 1 =>

            data_o <= max_cycles(63 downto 32);

          when BANK_ADDRESS / 4 =>

            data_o <= bank(31 downto 0);

          when PRIOR_SELECT_ADDRESS / 4 =>

            data_o <= prior_select(31 downto 0);

          when RUN_UNTIL_ADDRESS / 4 =>

            data_o <= run_until(31 downto 0);

          when RUN_UNTIL_ADDRESS / 4 + 1 =>

            data_o <= run_until(63 downto 32);

          when START_ADDRESS / 4 =>

            data_o <= start(31 downto 0);

          when RESUME_ADDRESS / 4 =>

            data_o <= resume(31 downto 0);

          when DONE_ADDRESS / 4 =>

            data_o <= done_i(31 downto 0);

          when STATUS_ADDRESS / 4 =>

            data_o <= status_i(31 downto 0);

          when CYCLES_ADDRESS / 4 =>

            data_o <= cycles_i(31 downto 0);
            -- the high word is held until it is read, so that the pair is never torn
            cycles_high <= cycles_i(63 downto 32);
            cycles_held <= '1';

          when CYCLES_ADDRESS / 4 + 1 =>

            if (cycles_held = '1') then
              data_o <= cycles_high;
            else
              data_o <= cycles_i(63 downto 32);
            end if;
            cycles_held <= '0';

          when COMPUTE_NS_ADDRESS / 4 =>

            data_o <= compute_ns_i(31 downto 0);
            -- the high word is held until it is read, so that the pair is never torn
            compute_ns_high <= compute_ns_i(63 downto 32);
            compute_ns_held <= '1';

          when COMPUTE_NS_ADDRESS / 4 + 1 =>

            if (compute_ns_held = '1') then
              data_o <= compute_ns_high;
            else
              data_o <= compute_ns_i(63 downto 32);
            end if;
            compute_ns_held <= '0';

          when HALT_ADDRESS / 4 =>

            data_o <= halt(31 downto 0);

          when HALT_ADDRESS / 4 + 1 =>

            data_o <= halt(63 downto 32);

          when HALT_ADDRESS / 4 + 2 =>

            data_o <= halt(95 downto 64);

          when HALT_ADDRESS / 4 + 3 =>

            data_o <= halt(127 downto 96);

          when HALT_ADDRESS / 4 + 4 =>

            data_o <= halt(159 downto 128);

          when HALT_ADDRESS / 4 + 5 =>

            data_o <= halt(191 downto 160);

          when HALT_ADDRESS / 4 + 6 =>

            data_o <= halt(223 downto 192);

          when HALT_ADDRESS / 4 + 7 =>

            data_o <= halt(255 downto 224);

          when others =>

            data_o <= (others => '0');

        end case;

      end if;
      if (rst_i = '1') then
        cycles_held <= '0';
        compute_ns_held <= '0';
      end if;
    end if;

  end process select_word;

end architecture rtl;
